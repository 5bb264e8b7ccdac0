# SPDX-License-Identifier: Apache-2.0
"""A constant difference of two body frames: found where it is, not imagined where the frames are the same."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.estimation.body_frame import body_offset
from slam_core.evaluation import evaluate
from slam_core.geometry import FloatArray, boxplus, invert_transform, make_transform, so3_exp
from slam_core.trajectory import Trajectory


def walk(rng: np.random.Generator, planar: bool = False, n: int = 200) -> FloatArray:
    axes = np.array([0.0, 0.0, 1.0]) if planar else np.ones(3)
    rates = 0.04 * axes * np.sin(np.arange(n)[:, None] / [11.0, 17.0, 23.0])
    poses = [np.eye(4)]
    for rate in rates:
        poses.append(poses[-1] @ make_transform(so3_exp(rate), np.array([0.02, 0.0, 0.0])))
    return np.array(poses)


def noisy(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    return boxplus(poses, rng.standard_normal((len(poses), 6)) * np.repeat([0.003, 0.002], 3))


X = make_transform(so3_exp(np.array([1.2, -1.1, 1.3])), np.array([0.05, -0.07, 0.02]))


def test_a_camera_and_the_body_it_sits_on_are_told_apart(rng: np.random.Generator) -> None:
    truth = walk(rng)
    estimate = noisy(truth @ invert_transform(X), rng)
    found = body_offset(estimate, truth)
    assert found is not None
    np.testing.assert_allclose(found[:3, :3], X[:3, :3], atol=0.02)
    np.testing.assert_allclose(found[:3, 3], X[:3, 3], atol=0.01)


def test_the_same_frame_is_left_alone(rng: np.random.Generator) -> None:
    assert body_offset(noisy(walk(rng), rng), walk(rng)) is None


def test_turns_about_one_axis_cannot_tell(rng: np.random.Generator) -> None:
    truth = walk(rng, planar=True)
    assert body_offset(truth @ invert_transform(X), truth) is None


@pytest.mark.parametrize("aligned", [False, True])
def test_evaluation_names_it_and_takes_it_off_when_asked(rng: np.random.Generator, aligned: bool) -> None:
    truth, stamps = walk(rng), np.arange(201) * 10**8
    covariances = np.tile(np.diag(np.repeat([0.003, 0.002], 3) ** 2) * 2.0, (201, 1, 1))
    estimate = Trajectory(stamps, noisy(truth @ invert_transform(X), rng), covariances)
    result = evaluate(estimate, Trajectory(stamps, truth), align_body=aligned)
    assert result.body_offset is not None
    assert result.body_aligned is aligned
    assert (result.ate_rotation_deg.rmse < 1.0) is aligned
    assert result.anees is not None
    assert (result.anees < 5.0) is aligned
