# SPDX-License-Identifier: Apache-2.0
"""Drift that no residual shows: a random walk of rigid motions about the camera, added to the poses that go out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ekf_slam_node.config import EkfSlamConfig, SubmapConfig
from ekf_slam_node.filtering.drift import Drift
from ekf_slam_node.slam import EkfSlam
from feature_world import loop, room
from slam_core.geometry import FloatArray
from slam_core.types import Features

COMMON = np.repeat([0.004, 0.002], 3)


def test_the_pose_is_moved_by_turns_about_each_place_of_the_camera(rng: np.random.Generator) -> None:
    drift, places, end = Drift(), rng.normal(size=(40, 3)), np.array([1.0, -2.0, 0.5])
    for place in places:
        drift.add(COMMON, place)
    shifts, turns = COMMON[0] * rng.normal(size=(20000, 40, 3)), COMMON[3] * rng.normal(size=(20000, 40, 3))
    errors = np.hstack([(shifts + np.cross(turns, end - places)).sum(axis=1), turns.sum(axis=1)])
    covariance = drift.covariance(end)
    scale = np.sqrt(np.diag(covariance))
    found = np.cov(errors.T) / np.outer(scale, scale)
    np.testing.assert_allclose(found, covariance / np.outer(scale, scale), atol=0.04)


def pose_and_end(shared_px: float, drift: bool = False) -> tuple[FloatArray, FloatArray]:
    """Covariances (6, 6) of the last pose given out and of the submap's end, after a walk in a single submap.

    Every frame bends its picture smoothly, another way each time.
    """
    rng = np.random.default_rng(3)
    without_end = EkfSlamConfig(submap=SubmapConfig(max_distance=100.0, max_landmarks=10**6, drift=drift))
    world, slam = room(rng), EkfSlam(without_end)
    for k, T in enumerate(loop(40)):
        features, _ = world.features(T, k * 100_000_000, rng)
        result = slam.process(_bent(features, shared_px * rng.normal(size=4)))
    (submap,) = slam.finish()
    return result.pose.covariance, submap.covariance[:6, :6]


def _bent(features: Features, amount: np.ndarray) -> Features:
    u, v = (features.uv / 200.0).T
    shift = np.column_stack([amount[0] * np.sin(u) + amount[1] * v, amount[2] * u * v + amount[3] * np.cos(v)])
    return replace(features, uv=features.uv + shift.astype(np.float32))


def test_poses_know_of_the_drift_and_submaps_do_not() -> None:
    pose, end = pose_and_end(0.6)
    assert np.linalg.eigvalsh(pose - end).min() > 0.0
    assert np.trace(pose[3:, 3:]) > 2.0 * np.trace(end[3:, 3:])


def test_a_submap_of_one_filter_alone_ends_as_uncertain_as_the_pose() -> None:
    pose, end = pose_and_end(0.6, drift=True)
    np.testing.assert_allclose(end, pose, rtol=1e-9, atol=2e-12)


def test_exact_cameras_do_not_drift() -> None:
    pose, end = pose_and_end(0.0)
    np.testing.assert_allclose(pose, end, rtol=1e-9, atol=2e-12)  # its start has a micrometre
