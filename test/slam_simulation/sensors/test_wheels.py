# SPDX-License-Identifier: Apache-2.0
"""The wheels' sensor: the planar motion below the rig, radius and slip as asked for, whoever asks how often."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.geometry import euler_from_rotation, invert_transform
from slam_core.types import OdometryReading
from slam_simulation.scenario import Scenario
from slam_simulation.sensors.wheels import WheelSensor, WheelSensorConfig
from slam_simulation.trajectory import Path

HEIGHT, SECONDS = 1.2, 33.0


@pytest.fixture(scope="module")
def path() -> Path:
    return Scenario.load("workshop_rig").path()


def read(path: Path, seed: int = 0, **config: float | bool) -> tuple[OdometryReading, ...]:
    return WheelSensor(WheelSensorConfig(**config), path, HEIGHT, (seed,)).read(-1.0, SECONDS, 10**12)  # type: ignore[arg-type]


def planar(reading: OdometryReading) -> np.ndarray:
    return np.array([*reading.T[:2, 3], euler_from_rotation(reading.T[:3, :3])[0]])


def test_wheels_without_slip_report_the_way_over_the_floor(path: Path) -> None:
    exact = read(path, slip=0.0)
    mount = exact[0].T_rig_frame
    assert mount[2, 3] == -HEIGHT
    start, end = (path.pose((exact[k].stamp_ns - 10**12) * 1e-9) @ mount for k in (0, -1))
    true = invert_transform(start) @ end
    np.testing.assert_allclose(planar(exact[-1])[:2], true[:2, 3], atol=0.02)  # the rig leans a little
    assert abs(np.sin(planar(exact[-1])[2] - euler_from_rotation(true[:3, :3])[0])) < 1e-3
    larger = read(path, slip=0.0, radius_error=0.1)
    np.testing.assert_allclose(larger[500].T[:2, 3], 1.1 * exact[500].T[:2, 3], rtol=1e-9)


def test_slip_is_as_large_as_the_covariance_says(path: Path) -> None:
    exact = read(path, slip=0.0)
    squared = []
    for seed in range(20):
        slipped = read(path, seed, slip=0.01)[600]
        error = planar(slipped) - planar(exact[600])
        error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
        rows = np.ix_([0, 1, 5], [0, 1, 5])
        squared.append(error @ np.linalg.solve(slipped.covariance[rows], error) / 3.0)
    assert 0.5 < np.mean(squared) < 1.7


def test_readings_do_not_depend_on_how_often_they_are_asked_for(path: Path) -> None:
    sensor = WheelSensor(WheelSensorConfig(), path, HEIGHT, (0,))
    parts = [r for k in range(330) for r in sensor.read(0.1 * k - 0.1 if k else -1.0, 0.1 * k, 10**12)]
    whole = read(path)
    assert [r.stamp_ns for r in parts] == [r.stamp_ns for r in whole]
    assert all((a.T == b.T).all() for a, b in zip(parts, whole, strict=True))
    assert not read(path, claims_covariance=False)[-1].covariance.any()
