# SPDX-License-Identifier: Apache-2.0
"""The antenna's sensor: where it is in the building, with the noise that it reports, and the outliers asked for."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.geometry import transform_points
from slam_simulation.sensors.position import T_BUILDING_WORLD, PositionSensor, PositionSensorConfig
from slam_simulation.trajectory import MOTION_STYLES, Path, SplinePath, resolve_waypoints

ARM = (0.1, 0.2, 0.3)
CONFIG = PositionSensorConfig(rate=10.0, sigma=0.05, outlier_share=0.2, outlier_distance=7.0, lever_arm=ARM)


@pytest.fixture
def path() -> Path:
    waypoints = resolve_waypoints([[0.0, 0.0, 0.0], [5.0, 1.0], [6.0, 4.0]], 1.2)
    return SplinePath(waypoints, 60.0, MOTION_STYLES["rig"], np.random.default_rng(1))


def test_readings_are_where_the_antenna_is_but_for_outliers(path: Path) -> None:
    sensor = PositionSensor(CONFIG, path, (3,))
    readings = sensor.read(-1.0, 60.0, 10**12)
    assert len(readings) == 601
    truth = [
        transform_points(T_BUILDING_WORLD @ path.pose(1e-9 * (r.stamp_ns - 10**12)), np.array([ARM]))[0]
        for r in readings
    ]
    error = np.array([r.position for r in readings]) - np.array(truth)
    good = error[~sensor.is_outlier]
    assert good.std(axis=0) == pytest.approx([0.05] * 3, rel=0.15)
    assert np.linalg.norm(error[sensor.is_outlier], axis=1).mean() == pytest.approx(7.0, abs=0.05)
    assert sensor.is_outlier.mean() == pytest.approx(0.2, abs=0.05)
    assert all((r.covariance == 0.05**2 * np.eye(3)).all() for r in readings)


def test_readings_do_not_depend_on_how_often_they_are_asked_for(path: Path) -> None:
    sensor = PositionSensor(CONFIG, path, (3,))
    whole = sensor.read(-1.0, 20.0, 0)
    parts = [r for k in range(-1, 20) for r in sensor.read(float(k), k + 1.0, 0)]
    assert [r.stamp_ns for r in whole] == [r.stamp_ns for r in parts]
    assert all((a.position == b.position).all() for a, b in zip(whole, parts, strict=True))
