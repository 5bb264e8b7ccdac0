# SPDX-License-Identifier: Apache-2.0
"""The error that all features of a frame share: found where it is, zero where noise is fresh, and believed by the
filter.
"""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.filtering.correlated_noise import CorrelatedNoise
from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.models import observe
from ekf_slam_node.odometry.relative_poses import ALL, ROTATION, RelativePoseMeasurement
from ekf_slam_node.slam import EkfSlam
from ekf_slam_node.submaps.motion_checks import widened
from feature_world import CAMERA, T_RIG_OPTICAL, PointWorld, loop, room
from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import FloatArray, boxminus, boxplus

WIDTH = 640


def pixels(rng: np.random.Generator, n: int = 100) -> FloatArray:
    return rng.uniform([0.0, 0.0], [WIDTH, 480.0], (n, 2))


def smooth_field(uv: FloatArray, rng: np.random.Generator, size: float) -> FloatArray:
    """A field of waves some 300 px long, ``size`` px root mean square."""
    phase, turn = rng.uniform(0.0, 2.0 * np.pi, 2), rng.uniform(0.0, 2.0 * np.pi)
    along = uv @ [np.cos(turn), np.sin(turn)]
    return np.sqrt(2.0) * size * np.sin(2.0 * np.pi * along[:, None] / 300.0 + phase)


def test_fresh_noise_is_not_taken_for_a_common_error(rng: np.random.Generator) -> None:
    common = CorrelatedNoise(2.5)
    for _ in range(300):
        uv = pixels(rng)
        common.learn(uv, 0.6 * rng.standard_normal((100, 2)), WIDTH)
        assert common.shared_px < 0.1
    assert common.shared_px == 0.0


def test_a_smooth_error_is_found_below_larger_noise(rng: np.random.Generator) -> None:
    common = CorrelatedNoise(2.5)
    for _ in range(200):
        uv = pixels(rng)
        common.learn(uv, smooth_field(uv, rng, 0.3) + 0.6 * rng.standard_normal((100, 2)), WIDTH)
    assert common.shared_px == pytest.approx(0.25, abs=0.06)


def test_nothing_is_said_where_it_is_switched_off_or_unknown(rng: np.random.Generator) -> None:
    off, uv = CorrelatedNoise(0.0), pixels(rng)
    off.learn(uv, smooth_field(uv, rng, 1.0), WIDTH)
    assert (off.shared_px, CorrelatedNoise(2.5).shared_px) == (0.0, 0.0)


def test_the_update_is_honest_about_a_pose_error_that_all_features_share(rng: np.random.Generator) -> None:
    """Exact landmarks, seen from a pose that errs: what the filter says of the rig's own pose must hold."""
    points = np.column_stack([rng.uniform(2, 5, 60), rng.uniform(-1, 1, 60), rng.uniform(-1, 1, 60)])
    common, sigma = np.repeat([0.003, 0.002], 3), np.array([0.3, 0.3, 0.002])
    values: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(60):
        error = rng.standard_normal(6) * np.repeat([0.01, 0.005], 3)
        T_camera = boxplus(boxplus(np.eye(4), error), common * rng.standard_normal(6))
        z = observe(T_camera, T_RIG_OPTICAL, points, CAMERA).z + sigma * rng.standard_normal((60, 3))
        for told in values:
            P = np.diag(np.r_[np.repeat([0.01, 0.005], 3) ** 2, np.full(6, 0.01), np.full(180, 1e-12)])
            ekf = Ekf(np.zeros(6), P, landmarks=points)
            seen = observe(ekf.T, T_RIG_OPTICAL, ekf.landmarks, CAMERA)
            ekf.update(z, np.tile(sigma**2, (60, 1)), seen, np.arange(60), common if told else None)
            values[told].append(float(nees(boxminus(boxplus(np.eye(4), error), ekf.T), ekf.pose_covariance())))
    low, high = anees_bounds(6, 60)
    assert low < np.mean(values[True]) / 6 < high
    assert np.mean(values[False]) / 6 > 5.0


def test_smooth_errors_widen_the_poses_of_a_run(rng: np.random.Generator) -> None:
    sizes = {}
    for size in (0.0, 1.0):
        world: PointWorld = room(np.random.default_rng(1))
        slam, noise = EkfSlam(EkfSlamConfig()), np.random.default_rng(2)
        for k, T in enumerate(loop(60)):
            features, _ = world.features(T, k * 100_000_000, noise)
            features.uv[:] += smooth_field(features.uv.astype(np.float64), noise, size).astype(np.float32)
            result = slam.process(features)
        sizes[size] = float(np.sqrt(np.trace(result.pose.covariance[:3, :3])))
    assert sizes[1.0] > 1.3 * sizes[0.0]


def test_a_scan_motion_is_as_sure_as_the_frames_it_joins() -> None:
    common = np.repeat([0.003, 0.002], 3)
    scan, gyro = (
        RelativePoseMeasurement(np.eye(4), 1e-6 * np.eye(6), ALL),
        RelativePoseMeasurement(np.eye(4), 1e-6 * np.eye(3), ROTATION),
    )
    np.testing.assert_allclose(np.diag(widened(scan, common).covariance), 1e-6 + 2.0 * common**2)
    np.testing.assert_array_equal(widened(gyro, common).covariance, gyro.covariance)
