# SPDX-License-Identifier: Apache-2.0
"""The public Linear SLAM sets through the tree of regions: the optimum and covariances of one factor."""

from __future__ import annotations

import numpy as np
import pytest

from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import flatten
from sjsam_node.regions.tasks import InProcess
from sjsam_node.regions.tree_problem import TreeProblem
from slam_core.estimation.least_squares import LevenbergMarquardtConfig, levenberg_marquardt
from slam_experiments.linear_slam.text_joining import TextIndex, TextJoiner, TextJoiningConfig
from slam_experiments.linear_slam.text_maps import find_maps, read_maps


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", ["8240_data_50_local_maps", "DLR_200_local_maps"])
def test_the_tree_gives_the_optimum_and_covariances_of_one_factor(data_dir, name):
    joiner = TextJoiner(TextIndex.of(*read_maps(find_maps(data_dir / "linear_slam_txt" / name))), TextJoiningConfig())
    state, known = joiner.best(None)
    problem = JoiningProblem(flatten(joiner.maps), state, np.array([0]), joiner.model)
    tree = TreeProblem(problem, state, InProcess())
    # From beside the optimum back to it.
    rng = np.random.default_rng(1)
    start = tree.retract(state, 1e-3 * rng.normal(size=int(tree.tree.start[-1])))
    _, result = levenberg_marquardt(tree, start, LevenbergMarquardtConfig(relative_tolerance=1e-15))
    assert result.cost == pytest.approx(known.cost, rel=1e-9)
    tree.tree.eliminate(state)
    poses, landmarks = tree.tree.covariances()
    for mine, expected in zip((poses, landmarks), joiner.covariances(state), strict=True):
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
        assert (np.abs(mine - expected) <= 1e-9 * scale).all()
