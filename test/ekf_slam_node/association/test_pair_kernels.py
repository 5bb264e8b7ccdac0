# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of the motion guess against the filter's NumPy models."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.association.pair_kernels import PairErrors, gated, normal_equations, pair_errors, readout_equations
from ekf_slam_node.filtering.candidates import Candidates, innovation_covariance, predict
from ekf_slam_node.filtering.models import Frame, Observation, frame_from_features, relative_motion, rig_points
from feature_world import T_RIG_OPTICAL, room

T = relative_motion(np.array([0.3, -0.2, 0.1, 0.05, 0.1, 0.4]), 1.0)


@pytest.fixture
def scene(rng: np.random.Generator) -> tuple[Candidates, Frame]:
    features, _ = room(rng, 400).features(np.eye(4), 0, rng, max_features=60)
    frame = frame_from_features(features, np.arange(len(features)), 0.01, 1e-5)
    points, covariances = rig_points(frame, T_RIG_OPTICAL)
    points[0, 0] = -1.0  # behind the camera
    return Candidates(points, covariances, frame.descriptors, frame.tracks), frame


@pytest.fixture
def filled(scene: tuple[Candidates, Frame]) -> PairErrors:
    candidates, frame = scene
    c = frame.camera
    pairs = PairErrors.room(len(frame))
    pair_errors(
        candidates.points, candidates.covariances, frame.z, frame.variance, T @ T_RIG_OPTICAL, T[:3, 3],
        np.array([c.fx, c.fy, c.cx, c.cy]), pairs.error, pairs.S, pairs.J, pairs.depth,
    )  # fmt: skip
    return pairs


@pytest.fixture
def seen(scene: tuple[Candidates, Frame]) -> Observation:
    return predict(scene[0], T, T_RIG_OPTICAL, scene[1])


def scaled(pairs: PairErrors, scale: np.ndarray) -> np.ndarray:
    return np.asarray(pairs.S * np.outer(scale, scale))


def test_errors_covariances_and_jacobians(
    scene: tuple[Candidates, Frame], filled: PairErrors, seen: Observation
) -> None:
    S = innovation_covariance(seen, scene[0], None)
    S[:, np.arange(3), np.arange(3)] += scene[1].variance
    for value, expected in (
        (filled.error, scene[1].z - seen.z),
        (filled.S, S),
        (filled.J, seen.J_pose),
        (filled.depth, seen.depth),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9 * np.abs(expected[1:]).max())


def test_gate(filled: PairErrors) -> None:
    scale = np.array([1.5, 1.5, 0.8])
    whitened = np.linalg.solve(scaled(filled, scale), filled.error[:, :, None])[:, :, 0]
    distance = np.einsum("ni,ni->n", filled.error, whitened)
    gate = float(np.median(distance))
    inside = gated(filled.error, filled.S, filled.depth, scale, gate)
    np.testing.assert_array_equal(inside, (distance < gate) & (filled.depth > 0.05))
    assert 0 < inside.sum() < len(inside)
    assert not gated(filled.error, filled.S, filled.depth, scale, np.inf)[0]


def test_normal_equations(filled: PairErrors) -> None:
    scale = np.array([1.2, 1.2, 2.0])
    chosen = np.arange(len(filled.error)) % 3 > 0
    information, gradient = normal_equations(filled.error, filled.S, filled.J, chosen, scale)
    J, weight = filled.J[chosen], np.linalg.inv(scaled(filled, scale)[chosen])
    np.testing.assert_allclose(information, np.einsum("nki,nkl,nlj->ij", J, weight, J), rtol=1e-9)
    np.testing.assert_allclose(gradient, np.einsum("nki,nkl,nl->i", J, weight, filled.error[chosen]), rtol=1e-8)


def test_equations_of_a_readout_with_far_off_pairs_weighed_less(filled: PairErrors, rng: np.random.Generator) -> None:
    error, S, J = filled.error[1:], filled.S[1:], filled.J[1:]  # the first is behind the camera
    scale, x = np.array([1.2, 1.2, 2.0]), 1e-3 * rng.normal(size=7)
    slope = rng.normal(size=(len(error), 3))
    H, weight = np.concatenate([J, -slope[:, :, None]], axis=2), np.linalg.inv(S * np.outer(scale, scale))
    left = error - H @ x
    size = np.sqrt(np.einsum("ni,nij,nj->n", left, weight, left))
    huber = float(np.median(size))
    share = 1.0 / np.maximum(1.0, size / huber)
    information, gradient = np.empty((7, 7)), np.empty(7)
    readout_equations(error, S, J, slope, scale, x, huber, information, gradient)
    for found, expected in (
        (information, np.einsum("n,nki,nkl,nlj->ij", share, H, weight, H)),
        (gradient, np.einsum("n,nki,nkl,nl->i", share, H, weight, error)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
