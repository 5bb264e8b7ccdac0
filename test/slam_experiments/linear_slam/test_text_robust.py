# SPDX-License-Identifier: Apache-2.0
"""Text submaps joined with a robust loss: false closures leave no trace, true maps stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from text_world import city, park

from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import flatten
from sjsam_node.joint_problem.robust import RobustConfig
from slam_experiments.linear_slam.text_joining import (
    TextIndex,
    TextJoiner,
    TextJoiningConfig,
    TextJoiningResult,
    join_text_maps,
)
from slam_experiments.linear_slam.text_maps import TextMap


def with_false_loops(
    maps: list[TextMap], rng: np.random.Generator, share: float
) -> tuple[list[TextMap], list[TextMap], int]:
    """The maps with some of their loops led elsewhere, and the maps without these."""
    false, clean, count = [], [], 0
    for k, m in enumerate(maps):
        spoilt = len(m.pose_ids) > 1 and k > 60 and rng.random() < share
        wrong = np.array([m.pose_ids[0], rng.integers(0, k - 30)]) if spoilt else m.pose_ids
        count += int(spoilt)
        covariance = np.linalg.inv(m.information)
        false.append(replace(m, pose_ids=wrong))
        clean.append(
            replace(m, pose_ids=m.pose_ids[:1], poses=m.poses[:1], information=np.linalg.inv(covariance[:3, :3]))
            if spoilt
            else m
        )
    return false, clean, count


def joined(maps: list[TextMap], loss: str) -> TextJoiningResult:
    return join_text_maps(maps, 2, TextJoiningConfig(refinements=0, robust=RobustConfig(loss)))


@pytest.mark.parametrize("loss", ["cauchy", "dcs"])
def test_false_loops_leave_no_trace(loss: str, rng: np.random.Generator) -> None:
    false, clean, count = with_false_loops(city(400, seed=3, extent=6), rng, 0.1)
    assert count >= 5
    truth, plain, robust = joined(clean, "none"), joined(false, "none"), joined(false, loss)
    assert robust.dropped == count
    assert robust.chi2 == pytest.approx(truth.chi2, rel=1e-6)
    assert np.allclose(robust.poses, truth.poses, atol=1e-5)
    assert np.abs(plain.poses - truth.poses).max() > 1.0


def test_covariances_are_those_without_the_false_loops(rng: np.random.Generator) -> None:
    """Neither of a compromise of weights nor of rows that are wrong."""
    false, clean, _ = with_false_loops(city(300, seed=4, extent=6), rng, 0.1)
    config = TextJoiningConfig(refinements=0, robust=RobustConfig("cauchy"))
    joiner = TextJoiner(TextIndex.of(false, 2), config)
    state, _ = joiner.best(None)
    expected = JoiningProblem(flatten(TextIndex.of(clean, 2).maps), state, np.array([0]), joiner.model)
    found = JoiningProblem(flatten(joiner.maps), state, np.array([0]), joiner.model)
    poses = np.array([50, 150, 300])
    assert np.allclose(found.columns(state, poses), expected.columns(state, poses), rtol=1e-6)


def test_a_feature_taken_for_another_is_left_out(rng: np.random.Generator) -> None:
    maps = park(120, 2, seed=1, features=80)
    false = []
    for k, m in enumerate(maps):
        ids = m.feature_ids.copy()
        if k % 20 == 19 and len(ids) > 2:
            ids[1] = rng.choice(np.setdiff1d(np.arange(1, 81), ids))
        false.append(replace(m, feature_ids=ids))
    spoilt = sum(bool(np.any(a.feature_ids != b.feature_ids)) for a, b in zip(maps, false, strict=True))
    truth, robust = joined(maps, "none"), joined(false, "cauchy")
    assert spoilt >= 5
    assert robust.dropped >= spoilt - 1  # one may be seen nowhere else: then nothing contradicts it
    assert np.abs(robust.poses - truth.poses).max() < 0.1


def test_true_maps_are_left_as_they_are() -> None:
    maps = city(200, seed=5, extent=6)
    plain, robust = joined(maps, "none"), joined(maps, "dcs")
    assert robust.dropped == 0
    assert robust.chi2 == pytest.approx(plain.chi2, rel=1e-9)
