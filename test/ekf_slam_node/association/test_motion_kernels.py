# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of the motion between two frames against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.association import motion_kernels as kernels
from ekf_slam_node.filtering.models import frame_from_features, rig_points
from feature_world import CAMERA, T_RIG_OPTICAL, room
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import boxplus, invert_transform, make_transform, so3_exp


@pytest.mark.parametrize("noise", [0.0, 0.3, 2.0])
def test_themotion_of_three_points_is_that_of_least_squares(rng: np.random.Generator, noise: float) -> None:
    for _ in range(50):
        source, T = rng.standard_normal((3, 3)), np.eye(4)
        target = source @ so3_exp(2.0 * rng.standard_normal(3)).T + rng.standard_normal(3)
        target += noise * rng.standard_normal((3, 3))
        kernels.motion_of_three(source, target, np.array([2, 0, 1]), T)
        np.testing.assert_allclose(T, umeyama(source, target), atol=1e-6)


def test_three_different_pairs_are_drawn_evenly(rng: np.random.Generator) -> None:
    counts, sample = np.zeros((5, 5)), np.empty(3, dtype=np.int64)
    for draw in rng.random((6000, 3)):
        kernels.draw_three(draw, 5, sample)
        assert len(set(sample)) == 3
        counts[sample[0], sample[1]] += 1
        counts[sample[2], sample[2]] += 1
    np.testing.assert_allclose(counts[~np.eye(5, dtype=bool)], 300.0, atol=80.0)
    np.testing.assert_allclose(np.diag(counts), 1200.0, atol=150.0)


def test_the_best_sample_has_the_least_cost(rng: np.random.Generator) -> None:
    """What is not summed up to its end could not have been the best."""
    features, _ = room(rng, 400).features(np.eye(4), 0, rng, max_features=60)
    frame = frame_from_features(features, np.arange(len(features)), 0.01, 1e-5)
    points, spread = rig_points(frame, T_RIG_OPTICAL)
    T = make_transform(so3_exp(np.array([0.02, -0.03, 0.01])), np.array([0.05, 0.02, -0.03]))
    moved = points @ T[:3, :3].T + T[:3, 3]
    moved[::5] += 1.0  # wrong pairs
    draws, none, gate = rng.random((100, 3)), np.zeros((0, 4, 4)), 30.0
    arguments = moved, spread, frame.z, frame.variance, T_RIG_OPTICAL, CAMERA.lens
    best = kernels.best_sample(*arguments, draws, none, gate)
    each = np.array([kernels.best_sample(*arguments, draw[None], none, gate) for draw in draws])
    assert best.tolist() == kernels.best_sample(*arguments, np.zeros((0, 3)), each, gate).tolist()
    optical = invert_transform(T_RIG_OPTICAL)
    np.testing.assert_allclose(best, optical @ invert_transform(T) @ T_RIG_OPTICAL, atol=1e-3)


def test_inverse_of_a_matrix_that_has_one(rng: np.random.Generator) -> None:
    A = rng.standard_normal((6, 9))
    A, out = A @ A.T, np.empty((6, 6))
    assert kernels._inverse(A.copy(), out)
    np.testing.assert_allclose(out @ A, np.eye(6), atol=1e-9)
    assert not kernels._inverse(np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0]), out)


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-3, 1.0])
def test_a_pose_moves_by_an_error(rng: np.random.Generator, size: float) -> None:
    T = make_transform(so3_exp(rng.standard_normal(3)), rng.standard_normal(3))
    covariance = np.diag(np.arange(1.0, 7.0))
    gradient, moved = size * rng.standard_normal(6), T.copy()
    kernels._move(moved, covariance, gradient)
    np.testing.assert_allclose(moved, boxplus(T, covariance @ gradient), atol=1e-12)
