# SPDX-License-Identifier: Apache-2.0
"""Simulated lift rides: from rest to rest, seen from within the storey, felt by IMU and barometer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_simulation import Scenario
from slam_simulation.lift import LiftPath, LiftRide, seen_path
from slam_simulation.sensors.imu import ideal_reading
from slam_simulation.sensors.pressure import PressureSensor, PressureSensorConfig

RIDE = LiftRide(at=4, height=9.0, seconds=9.0, wait=1.5)


def path() -> LiftPath:
    made = Scenario.load("lift").path()
    assert isinstance(made, LiftPath)
    return made


def test_a_ride_rises_smoothly_from_rest_to_rest() -> None:
    times = np.arange(0.0, RIDE.stay, 0.01)
    heights = np.array([RIDE.risen(t) for t in times])
    assert heights[times < RIDE.wait].max() == 0.0
    assert heights[times >= RIDE.wait + RIDE.seconds - 1e-9] == pytest.approx(9.0)
    speed = np.diff(heights) / 0.01
    acceleration = np.diff(speed) / 0.01
    assert (speed >= -1e-9).all()
    assert speed.max() == pytest.approx(9.0 / (9.0 * 0.75), rel=1e-3)
    assert np.abs(acceleration).max() < 1.2
    assert np.abs(np.diff(acceleration)).max() < 0.05  # no jerk of a step


def test_pictures_show_the_storey_and_the_rest_the_true_motion() -> None:
    lift = path()
    seen, before, after = seen_path(lift), 1.0, lift.duration - 1.0
    np.testing.assert_array_equal(lift.pose(before), seen.pose(before))
    np.testing.assert_allclose(lift.pose(after)[:3, 3] - seen.pose(after)[:3, 3], [0.0, 0.0, 9.0], atol=1e-12)
    np.testing.assert_array_equal(lift.pose(after)[:3, :3], seen.pose(after)[:3, :3])
    speeds = [np.linalg.norm(seen.pose(t + 0.05)[:3, 3] - seen.pose(t)[:3, 3]) / 0.05 for t in np.arange(14, 22, 0.1)]
    assert max(speeds) < 0.02  # the rig stands in the cabin
    vertical = [ideal_reading(lift, t)[1][2] - 9.81 for t in np.arange(10.0, 25.0, 0.02)]
    assert max(vertical) > 0.8
    assert min(vertical) < -0.8
    assert sum(vertical) * 0.02 == pytest.approx(0.0, abs=0.05)


def test_a_barometer_tells_the_height() -> None:
    lift, config = path(), PressureSensorConfig(drift=0.0)
    sensor = PressureSensor(config, lift, (1, 2))
    readings = [*sensor.read(-1.0, 20.0, 7), *sensor.read(20.0, 100.0, 7)]
    assert [r.stamp_ns for r in readings] == [7 + 10**8 * k for k in range(len(readings))]
    first, last = (np.mean([r.pressure for r in part]) for part in (readings[:50], readings[-50:]))
    height = -29.27 * config.temperature * np.log(last / first)
    assert height == pytest.approx(9.0, abs=0.15)
    assert readings[0].variance == config.sigma**2


@pytest.mark.parametrize(
    ("rides", "message"),
    [
        ((LiftRide(0 + 1, 9.0), LiftRide(1, 3.0)), "ascending"),
        ((LiftRide(9, 9.0),), "inner"),
        ((LiftRide(4, 9.0, seconds=80.0),), "rides take"),
    ],
)
def test_rides_that_cannot_be_are_refused(rides: tuple[LiftRide, ...], message: str) -> None:
    scenario = Scenario.load("lift")
    agent = replace(scenario.agents[0], rides=rides)
    with pytest.raises(ValueError, match=message):
        replace(scenario, agents=(agent,)).path()


def test_a_ride_needs_a_way_point_and_time() -> None:
    with pytest.raises(ValueError, match="at >= 1"):
        LiftRide(0, 9.0)
