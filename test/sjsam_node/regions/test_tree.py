# SPDX-License-Identifier: Apache-2.0
"""The tree of regions gives what one factor of the whole problem gives: means and covariances, wherever tasks run."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from random_joining import MODELS, perturbed, random_problem

from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import flatten
from sjsam_node.regions.fronts import NotDetermined
from sjsam_node.regions.pieces import Eliminated
from sjsam_node.regions.tasks import InProcess
from sjsam_node.regions.tree import RegionTree
from sjsam_node.regions.tree_problem import TreeProblem
from slam_core.estimation.least_squares import LevenbergMarquardtConfig, levenberg_marquardt

FIXED = np.array([0])


def compare(maps, state, model, **sizes):
    flat = flatten(maps)
    problem, tree = JoiningProblem(flat, state, FIXED, model), RegionTree(flat, state, FIXED, model, **sizes)
    tree.eliminate(state)
    step, _ = problem.newton_step(state)
    one = state.retract(problem.layout.pose_offset, problem.layout.landmark_offset, step)
    other = state.retract(*tree.offsets, tree.step())
    for name in ("rotations", "translations", "landmarks"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=1e-9, atol=1e-9)
    marginals = problem.marginals(state)
    poses, landmarks = tree.covariances()
    known = np.unique(flat.landmarks)
    for mine, expected in (
        (poses, marginals.pose_blocks(np.arange(len(poses)))),
        (landmarks[known], marginals.landmark_blocks(known)),
    ):
        np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    return tree


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("sizes", [{"leaf_maps": 1, "task_maps": 1}, {"leaf_maps": 2, "task_maps": 9}, {}])
def test_means_and_covariances_are_those_of_one_factor(model, sizes):
    rng = np.random.default_rng(3)
    maps, state = random_problem(model, rng, maps=40, landmarks=60)
    tree = compare(maps, state, model, **sizes)
    assert sum(len(r.maps) for r in tree.root.regions() if not r.children) == 40


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_factors_that_are_not_kept_change_no_byte(model):
    maps, state = random_problem(model, np.random.default_rng(4), maps=40, landmarks=60)
    results, factors = [], []
    for kept in (40, 39):
        tasks = Counting()
        tree = RegionTree(flatten(maps), state, FIXED, model, tasks, leaf_maps=2, task_maps=9, kept_maps=kept)
        tree.eliminate(state, 0.1)
        factors.append(tasks.kept)
        results.append((tree.step(), *tree.covariances()))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
    assert factors[1] < 0.5 * factors[0], "only those above the pieces are left"


class Counting(InProcess):
    """Tasks here, and the bytes of the factors among their results."""

    def __init__(self):
        self.kept = 0

    def submit(self, function, *arguments):
        result = super().submit(function, *arguments)
        if isinstance(result, Eliminated):
            self.kept += len(pickle.dumps(result))
        return result


def test_every_variable_is_eliminated_once_and_the_root_leaves_none():
    maps, state = random_problem(MODELS["tangent"], np.random.default_rng(5), maps=30, landmarks=50)
    tree = RegionTree(flatten(maps), state, FIXED, MODELS["tangent"], leaf_maps=2)
    own = np.concatenate([region.own for region in tree.root.regions()])
    np.testing.assert_array_equal(np.sort(own), np.nonzero(tree.variables.width)[0])
    assert not len(tree.root.separator)


def test_a_part_that_hangs_on_nothing_is_told():
    maps, state = random_problem(MODELS["tangent"], np.random.default_rng(1), maps=8, landmarks=20)
    tree = RegionTree(flatten(maps), state, np.empty(0, dtype=np.int64), MODELS["tangent"], leaf_maps=2)
    with pytest.raises(NotDetermined, match="hangs on nothing"):
        tree.eliminate(state)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_levenberg_marquardt_on_the_tree_ends_where_it_does_on_one_factor(model):
    rng = np.random.default_rng(7)
    maps, state = random_problem(model, rng, maps=30, landmarks=40)
    problem = JoiningProblem(flatten(maps), state, FIXED, model)
    config = LevenbergMarquardtConfig(relative_tolerance=1e-14)
    one, expected = problem.optimize(perturbed(problem, state, rng, 0.02), config)
    other, found = levenberg_marquardt(TreeProblem(problem, state, InProcess()), state, config)
    assert found.converged
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    np.testing.assert_allclose(other.translations, one.translations, atol=1e-6)
    gradient = TreeProblem(problem, state, InProcess()).linearize(state)
    poses, landmarks = RegionTree(problem.maps, state, FIXED, model).offsets
    expected_gradient = problem.linearize(state)
    for mine, theirs, width in ((poses, problem.layout.pose_offset, state.model_dimensions[0]),
                                (landmarks, problem.layout.landmark_offset, state.model_dimensions[1])):  # fmt: skip
        for a, b in zip(mine[mine >= 0], theirs[theirs >= 0], strict=True):
            np.testing.assert_allclose(gradient[a : a + width], expected_gradient[b : b + width], rtol=1e-9, atol=1e-6)
