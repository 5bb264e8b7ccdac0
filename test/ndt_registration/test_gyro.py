# SPDX-License-Identifier: Apache-2.0
"""Turns from angular velocities: exact for a steady one, refused where samples are missing, and of use to odometry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ndt_registration.gyro import Gyro, GyroConfig
from ndt_registration.odometry import OdometryConfig, OdometryStatus, ScanOdometry
from slam_core.geometry import FloatArray, boxminus, invert_transform, so3_exp, so3_log

MS = 1_000_000
RATE = np.array([0.3, -0.2, 0.5])


def fed(stamps_ms: range | list[int], config: GyroConfig | None = None) -> Gyro:
    gyro = Gyro(config or GyroConfig(enabled=True))
    for stamp in stamps_ms:
        gyro.add(stamp * MS, RATE)
    return gyro


def test_a_steady_turn_is_exact_between_stamps_that_no_sample_has() -> None:
    gyro = fed(range(0, 400, 10))
    for start, end in ((3, 108), (108, 217), (217, 300)):
        R = gyro.turn(start * MS, end * MS)
        assert R is not None
        np.testing.assert_allclose(R, so3_exp(RATE * 1e-3 * (end - start)), atol=1e-12)


def test_a_changing_turn_multiplies_in_order() -> None:
    gyro = Gyro(GyroConfig(enabled=True))
    first, second = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0])
    gyro.add(0, first)
    gyro.add(20 * MS, second)
    R = gyro.turn(0, 40 * MS)
    assert R is not None
    np.testing.assert_allclose(R, so3_exp(0.02 * first) @ so3_exp(0.02 * second), atol=1e-12)


@pytest.mark.parametrize("stamps", [[], [60, 70, 80, 90], [0, 10, 20, 90], [0, 10, 20]])
def test_missing_samples_give_no_turn(stamps: list[int]) -> None:
    assert fed(stamps).turn(10 * MS, 95 * MS) is None


def test_switched_off_there_is_no_turn() -> None:
    assert fed(range(0, 100, 10), GyroConfig(enabled=False)).turn(0, 50 * MS) is None


def test_turns_that_no_steady_velocity_foretells_are_followed(
    room: Any, start: FloatArray, at: Callable[..., FloatArray]
) -> None:
    """The head is thrown round and back; the turn of each scan is the opposite of the last one's."""
    rng, step = np.random.default_rng(5), 100 * MS
    yaws = [0.0, 18.0, -14.0, 18.0, -16.0, 14.0]
    poses = [at(0.0, 0.0, 0.0, yaw) for yaw in yaws]
    scans = [room.scan(start @ T, rng, 60) for T in poses]
    outcomes = {}
    for enabled in (True, False):
        odometry = ScanOdometry(OdometryConfig(imu=GyroConfig(enabled=enabled)))
        results = []
        for k, scan in enumerate(scans):
            if k:
                rate = so3_log(poses[k - 1][:3, :3].T @ poses[k][:3, :3]) / 0.1
                for sample in range(10):
                    odometry.add_angular_velocity(1 + (k - 1) * step + sample * 10 * MS, rate)
            results.append(odometry.process(1 + k * step, scan))
        error = boxminus(results[-1].T, invert_transform(poses[0]) @ poses[-1])
        tracked = all(r.status is OdometryStatus.TRACKING for r in results[1:])
        outcomes[enabled] = tracked and bool(np.linalg.norm(error[:3]) < 0.03)
    assert outcomes == {True: True, False: False}
