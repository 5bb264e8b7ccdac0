# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ndt_registration.odometry import OdometryConfig, OdometryStatus, ScanOdometry
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform
from slam_core.types import RelativeMotion

STEP_NS = 40_000_000
PLANE = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])


def path(at: Callable[..., FloatArray], k: int) -> FloatArray:
    a = k / 40.0
    return at(0.8 * a, 0.3 * np.sin(4 * a), 0.03 * np.sin(5 * a), 15 * np.sin(5 * a), 3 * np.sin(4 * a), 2 * a)


@pytest.fixture(scope="module")
def scans(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> list[FloatArray]:
    rng = np.random.default_rng(5)
    return [room.scan(start @ path(at, k), rng, 60) for k in range(20)]


def test_follows_a_hand_held_motion(scans: list[FloatArray], at: Callable[..., FloatArray]) -> None:
    odometry = ScanOdometry()
    for k, scan in enumerate(scans):
        result = odometry.process(1 + k * STEP_NS, scan)
        assert result.status is (OdometryStatus.TRACKING if k else OdometryStatus.STARTED)
        if k:
            assert result.motion is not None
            truth = invert_transform(path(at, k - 1)) @ path(at, k)
            assert np.linalg.norm(boxminus(result.motion.T, truth)[:3]) < 0.03
            assert (result.motion.start_stamp_ns, result.motion.end_stamp_ns) == (
                1 + (k - 1) * STEP_NS,
                1 + k * STEP_NS,
            )
            assert np.linalg.eigvalsh(result.motion.covariance).min() > 0.0
    error = boxminus(result.T, invert_transform(path(at, 0)) @ path(at, 19))
    assert np.linalg.norm(error[:3]) < 0.03


@pytest.mark.parametrize(
    "bad", [np.empty((0, 3)), np.full((500, 3), np.nan), np.random.default_rng(1).normal(size=(800, 3))]
)
def test_a_bad_scan_is_not_integrated_and_the_next_recovers(
    scans: list[FloatArray], at: Callable[..., FloatArray], bad: FloatArray
) -> None:
    odometry = ScanOdometry()
    for k in range(6):
        before = odometry.process(1 + k * STEP_NS, scans[k])
    failed = odometry.process(1 + 6 * STEP_NS, bad)
    assert failed.status is OdometryStatus.FAILED
    assert failed.motion is None
    assert failed.reason
    assert np.linalg.eigvalsh(failed.covariance - before.covariance).min() > 0.0
    after = odometry.process(1 + 7 * STEP_NS, scans[7])
    assert after.status is OdometryStatus.TRACKING
    assert after.motion is None
    error = boxminus(after.T, path(at, 7))
    assert np.linalg.norm(error[:3]) < 0.03
    assert odometry.process(1 + 8 * STEP_NS, scans[8]).motion is not None


def test_starts_anew_when_it_stays_lost(scans: list[FloatArray]) -> None:
    odometry = ScanOdometry(OdometryConfig(restart_after=2))
    rng = np.random.default_rng(2)
    odometry.process(1, scans[0])
    results = [odometry.process(1 + k * STEP_NS, rng.normal((3.0, 0.0, 0.0), 1.0, (800, 3))) for k in (1, 2)]
    assert [r.status for r in results] == [OdometryStatus.FAILED, OdometryStatus.RESTARTED]
    assert results[1].covariance[0, 0] > results[0].covariance[0, 0]


def test_reset_makes_the_next_scan_the_origin(scans: list[FloatArray]) -> None:
    odometry = ScanOdometry()
    for k in range(3):
        odometry.process(1 + k * STEP_NS, scans[k])
    odometry.reset()
    result = odometry.process(5, scans[9])
    assert result.status is OdometryStatus.STARTED
    np.testing.assert_array_equal(result.T, np.eye(4))


def test_stamps_out_of_order_are_refused(scans: list[FloatArray]) -> None:
    odometry = ScanOdometry()
    odometry.process(100, scans[0])
    with pytest.raises(ValueError, match="order"):
        odometry.process(100, scans[1])


def test_before_a_single_wall_the_uncertainty_is_mostly_that_of_the_prediction(
    empty_room: Any, at: Callable[..., FloatArray]
) -> None:
    rng, wall = np.random.default_rng(5), empty_room(60.0, 60.0, 60.0)
    odometry, config = ScanOdometry(), OdometryConfig().motion
    odometry.process(1, wall.scan(at(57.0, 30.0, 30.0), rng, 60))
    result = odometry.process(1 + STEP_NS, wall.scan(at(57.02, 30.0, 30.0), rng, 60))
    assert result.registration is not None
    assert result.registration.degenerate
    assert result.motion is not None
    sigma, dt = np.sqrt(np.diag(result.motion.covariance)), 1e-9 * STEP_NS
    predicted = np.hypot(config.speed_sigma * dt, 0.5 * config.acceleration_sigma * dt**2)
    assert sigma[0] < 0.01
    assert 0.8 * predicted < sigma[1] < 1.01 * predicted
    assert 0.8 * predicted < sigma[2] < 1.01 * predicted


def test_along_a_blank_wall_no_motion_is_surer_than_it_is(empty_room: Any, at: Callable[..., FloatArray]) -> None:
    """Where a view ends moves with the sensor: it must not be taken for a wall that stays."""
    rng, wall, odometry = np.random.default_rng(8), empty_room(60.0, 60.0, 60.0), ScanOdometry()
    poses = [at(58.0, 30.0 + 0.02 * k + 0.0005 * k * k, 30.0, 0.3 * k, 0.0, 0.2 * k) for k in range(16)]
    nees = []
    for k, T in enumerate(poses):
        result = odometry.process(1 + k * STEP_NS, wall.scan(T, rng, 60))
        if k:
            assert result.motion is not None
            d = boxminus(result.motion.T, invert_transform(poses[k - 1]) @ T)
            nees.append(d @ np.linalg.solve(result.motion.covariance, d) / 6.0)
    assert np.mean(nees) < 2.0
    assert max(nees) < 6.0


def corridor_scan(T: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Points (n, 2) that a planar scanner sees of two long walls, 2 m apart, within 5 m."""
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False) + 0.004
    yaw = np.arctan2(T[1, 0], T[0, 0])
    slope = np.sin(angles + yaw)
    ranges = np.where(slope > 0, 1.0 - T[1, 3], 1.0 + T[1, 3]) / np.abs(slope) + 0.01 * rng.normal(size=360)
    points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.asarray(points[ranges < 5.0])


def test_wheels_carry_scans_along_a_corridor(at: Callable[..., FloatArray]) -> None:
    rng, odometry = np.random.default_rng(7), ScanOdometry()
    poses = [at(0.1 * k, 0.05 * np.sin(0.5 * k), 0.0, 3.0 * np.sin(0.4 * k)) for k in range(15)]
    sigma = np.array([0.002, 0.02, 1e-4, 1e-4, 1e-4, 0.02])
    for k, T in enumerate(poses):
        wheels = invert_transform(poses[max(k - 1, 0)]) @ T @ boxplus(np.eye(4), sigma * rng.normal(size=6) * PLANE)
        prior = RelativeMotion(1 + (k - 1) * STEP_NS, 1 + k * STEP_NS, wheels, np.diag(sigma**2))
        result = odometry.process(1 + k * STEP_NS, corridor_scan(T, rng), prior if k else None)
        assert result.status is (OdometryStatus.TRACKING if k else OdometryStatus.STARTED)
    error = boxminus(result.T, invert_transform(poses[0]) @ poses[-1])
    assert abs(error[0]) < 0.05
    assert abs(error[1]) < 0.02
    assert abs(error[5]) < 0.01
    np.testing.assert_allclose(error[2:5], 0.0, atol=1e-9)
