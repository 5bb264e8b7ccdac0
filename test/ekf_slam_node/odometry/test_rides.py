# SPDX-License-Identifier: Apache-2.0
"""Lift rides by accelerometer and barometer: found, honest heights, and none where a rig only climbs or stands."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import pytest

from ekf_slam_node.config import InertialConfig, MotionConfig, RideConfig
from ekf_slam_node.odometry.cabin import Ride
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer
from slam_core.geometry import (
    FloatArray,
    boxplus,
    invert_transform,
    make_transform,
    rotation_from_euler,
    so3_exp,
    so3_log,
)
from slam_core.types import ImuSample, PressureReading
from slam_simulation.lift import LiftRide as Journey

RATE, DT = 100.0, 1e-3
STANDS, SECONDS = 10.0, 26.0
SEEN = np.repeat([1.5e-3, 5e-4], 3)
"""Standard deviations (m, rad) of a motion that the images show."""
JOURNEY = Journey(at=1, height=9.0, seconds=9.0, wait=2.0)
NOISE = InertialConfig()


def within_storey(t: float) -> FloatArray:
    """Pose of a rig that walks half a circle until it stands, with a hand's unrest, and turns round slowly later."""
    s = min(t / (STANDS - 1.0), 1.0)
    angle = 3.0 * s**3 * (s * (6.0 * s - 15.0) + 10.0)
    sway = 0.004 * np.array([np.sin(2.1 * t), np.cos(1.3 * t), np.sin(1.7 * t)])
    tilt = 0.03 * np.array([np.sin(1.3 * t), np.sin(1.1 * t + 1.0), np.sin(0.7 * t + 2.0)])
    place = 1.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    return make_transform(rotation_from_euler(angle + 0.02 * t) @ so3_exp(tilt), place + sway)


def by_lift(t: float) -> float:
    return JOURNEY.risen(t - STANDS)


def by_stairs(t: float) -> float:
    """Up and down again, a step a second, while one walks."""
    return 1.5 * (1.0 - np.cos(0.7 * t)) / 2.0 + 0.03 * np.sin(2.0 * np.pi * 1.8 * t)


def stays(_: float) -> float:
    return 0.0


def by_escalator(t: float) -> float:
    """Upwards and as far again to the side."""
    return by_lift(t)


@cache
def ideal(height: Callable[[float], float]) -> tuple[list[float], FloatArray]:
    """Times, and rows of angular velocity and specific force without errors."""
    rows, times = [], [k / RATE for k in range(-1, int(SECONDS * RATE) + 2)]
    for t in times:
        poses = [within_storey(t + s) for s in (-DT, 0.0, DT)]
        axis = np.array([1.0 if height is by_escalator else 0.0, 0.0, 1.0])
        places = [T[:3, 3] + height(t + s) * axis for T, s in zip(poses, (-DT, 0.0, DT), strict=True)]
        force = (places[2] - 2.0 * places[1] + places[0]) / DT**2 + [0.0, 0.0, 9.81]
        turn = so3_log(poses[0][:3, :3].T @ poses[2][:3, :3]) / (2.0 * DT)
        rows.append(np.concatenate([turn, poses[1][:3, :3].T @ force]))
    return times, np.array(rows)


@dataclass
class Outcome:
    """Rides that were found, how many were begun and retracted, and the last one's height while it goes on."""

    rides: list[Ride]
    begun: int
    retracted: int
    aids: RelativePoseBuffer


def driven(
    height: Callable[[float], float],
    seed: int,
    seen_height: Callable[[float], float] = stays,
    pressure: Callable[[float], float] | None = None,
    use: str = "imu",
    fps: float = 5.0,
    push: Callable[[float], float] = stays,
    gap: tuple[float, float] = (-1.0, -1.0),
    seconds: float = SECONDS,
    is_live: bool = False,
) -> Outcome:
    """Rides that are found while the images show the motion within a storey, or ``seen_height`` of it.

    push: error of the upward specific force at a time, m/s2; gap: readings of the IMU between two times are missing;
    is_live: those after a frame are not known at it.
    """
    rng = np.random.default_rng(seed)
    times, rows = ideal(height)
    bias = np.concatenate([0.01 * rng.standard_normal(3), 0.05 * rng.standard_normal(3)])
    density = np.repeat([NOISE.gyroscope_noise_density, NOISE.accelerometer_noise_density], 3)
    rows = rows + bias + density * np.sqrt(RATE) * rng.standard_normal(rows.shape)
    aids = RelativePoseBuffer(MotionConfig(), NOISE, None, RideConfig(use=use))
    samples = deque(
        ImuSample(round(t * 1e9), row[:3], row[3:] + push(t) * np.eye(3)[2])
        for t, row in zip(times, rows, strict=True)
        if not gap[0] <= t < gap[1]
    )
    if pressure is not None:
        scale = 1.0 + 0.03 * rng.standard_normal()
        walk = np.cumsum(0.02 * np.sqrt(0.1) * rng.standard_normal(int(SECONDS * 10) + 1))
        for k, drift in enumerate(walk):
            pascal = 1e5 * np.exp(-(scale * pressure(0.1 * k) + drift) / 8434.0) + 1.5 * rng.standard_normal()
            assert not aids.rides.pressure.add(PressureReading(k * 10**8, pascal, 1.5**2))
    rides, begun, retracted, step_ns = [], 0, 0, round(1e9 / fps)
    for k in range(int(seconds * 1e9) // step_ns - 1):
        start, end = k * step_ns, (k + 1) * step_ns
        poses = [within_storey(1e-9 * at) for at in (start, end)]
        for T, at in zip(poses, (start, end), strict=True):
            T[2, 3] += seen_height(1e-9 * at)
        seen = boxplus(invert_transform(poses[0]) @ poses[1], SEEN * rng.standard_normal(6))
        while samples and (not is_live or samples[0].stamp_ns <= end + 1e9 / RATE):
            aids.add_imu(samples.popleft())
        aids.rides.forget_events()
        aids.moved(start, end, seen, np.diag(SEEN**2))
        begun += bool(aids.rides.begun)
        retracted += aids.rides.is_retracted
        if aids.rides.ended is not None:
            rides.append(aids.rides.ended)
    return Outcome(rides, begun, retracted, aids)


def ridden(
    height: Callable[[float], float],
    seed: int,
    seen_height: Callable[[float], float] = stays,
    pressure: Callable[[float], float] | None = None,
    use: str = "imu",
) -> list[Ride]:
    outcome = driven(height, seed, seen_height, pressure, use)
    assert outcome.aids.inertial.uses_force
    assert not outcome.aids.rides.is_riding
    return outcome.rides


def test_heights_of_rides_are_honest() -> None:
    """Their normalised errors have a mean of about one, as their smoothed heights on the way have."""
    errors, on_the_way, sigmas = [], [], []
    for seed in range(24):
        (ride,) = ridden(by_lift, seed)
        assert abs(ride.height - 9.0) < 0.6
        errors.append((ride.height - 9.0) ** 2 / ride.variance)
        middle = ride.heights[len(ride.heights) // 2]
        true = by_lift(1e-9 * middle.stamp_ns) - by_lift(1e-9 * ride.start_ns)
        on_the_way.append((middle.height - true) ** 2 / middle.variance)
        sigmas.append(np.sqrt(ride.variance))
        assert ride.start_ns < (STANDS + JOURNEY.wait + 1.0) * 1e9 < ride.end_ns < (STANDS + JOURNEY.stay + 1.5) * 1e9
    assert np.mean(sigmas) < 0.2
    assert 0.3 < np.mean(errors) < 1.7
    assert 0.3 < np.mean(on_the_way) < 1.9


def test_a_barometer_makes_heights_surer() -> None:
    errors = []
    for seed in range(12):
        (ride,), (alone,) = ridden(by_lift, seed, pressure=by_lift), ridden(by_lift, seed)
        errors.append((ride.height - 9.0) ** 2 / ride.variance)
        assert ride.variance < alone.variance
    assert 0.2 < np.mean(errors) < 2.2


@pytest.mark.parametrize(("height", "seen"), [(by_stairs, by_stairs), (stays, stays)])
def test_who_climbs_or_stands_does_not_ride(height: Callable[[float], float], seen: Callable[[float], float]) -> None:
    assert ridden(height, 3, seen) == []


def test_who_is_carried_sideways_too_does_not_ride_a_lift() -> None:
    assert ridden(by_escalator, 3) == []


def test_by_default_no_ride_is_found_without_a_barometer() -> None:
    outcome = driven(by_lift, 5, use="auto")
    assert (outcome.begun, outcome.aids.rides.is_looking) == (0, False)
    assert ridden(by_lift, 5, pressure=by_lift, use="off") == []


@pytest.mark.parametrize("told", [stays, lambda t: -by_lift(t), lambda t: 2.5 * by_lift(t)])
def test_a_barometer_that_tells_another_change_of_height_refutes_a_ride(told: Callable[[float], float]) -> None:
    assert ridden(by_lift, 5, pressure=told, use="auto") == []


def test_a_ride_that_a_barometer_confirms_is_found_from_its_start() -> None:
    for seed in range(4):
        (ride,) = ridden(by_lift, seed, pressure=by_lift, use="auto")
        assert abs(ride.height - 9.0) < 3.0 * np.sqrt(ride.variance) < 0.7
        assert ride.start_ns < (STANDS + JOURNEY.wait + 1.0) * 1e9


def test_a_ride_down_is_one_too() -> None:
    (ride,) = ridden(lambda t: -by_lift(t), 5)
    assert ride.height == pytest.approx(-9.0, abs=0.5)


def bobs(t: float) -> float:
    return 0.025 * float(np.sin(2.0 * np.pi * 1.8 * t))


def test_readings_that_are_missing_for_a_moment_are_no_ride() -> None:
    """Someone who bobs is seen to, and the few readings that are missing make the IMU's way much less certain."""
    for seed in range(3):
        assert driven(bobs, seed, bobs, fps=10.0, gap=(20.0, 20.25)).begun == 0


def test_an_accelerometer_whose_bias_jumps_is_in_no_lift_for_long() -> None:
    outcome = driven(stays, 3, push=lambda t: 0.4 * (t > 15.0))
    assert outcome.begun == outcome.retracted > 0
    assert outcome.rides == []
    assert not outcome.aids.rides.is_riding


def pushed(wrong_by: float, t: float) -> float:
    return wrong_by * (13.0 < t < 21.0)


def test_a_force_that_is_wrong_on_the_way_widens_the_height_or_refutes_the_ride() -> None:
    for wrong_by in (-0.03, 0.03):
        (ride,) = driven(by_lift, 3, push=partial(pushed, wrong_by)).rides
        (right,) = ridden(by_lift, 3)
        assert 4.0 * right.variance < ride.variance
        assert abs(ride.height - 9.0) < 2.0 * np.sqrt(ride.variance)
    wrong = driven(by_lift, 3, push=lambda t: -0.6 * (16.0 < t < 16.6))
    assert (wrong.rides, wrong.begun, wrong.retracted) == ([], 1, 1)


def test_a_ride_that_no_barometer_confirms_leaves_no_trace() -> None:
    suspecting, off = (driven(by_lift, 5, pressure=stays, use=use).aids.inertial for use in ("auto", "off"))
    np.testing.assert_array_equal(suspecting.covariance, off.covariance)
    np.testing.assert_array_equal(suspecting.velocity, off.velocity)
    assert suspecting.time_offset == off.time_offset
    assert suspecting.fork()._clock is not suspecting._clock


@pytest.mark.parametrize("gap", [(16.0, 16.45), (16.0, 17.6)])
def test_readings_missing_on_the_way_widen_the_height(gap: tuple[float, float]) -> None:
    errors = []
    for seed in range(3):
        (ride,) = driven(by_lift, seed, gap=gap, is_live=True).rides
        (whole,) = ridden(by_lift, seed)
        assert whole.variance < ride.variance < 9.0
        errors.append((ride.height - 9.0) ** 2 / ride.variance)
    assert max(errors) < 9.0


@pytest.mark.parametrize("fps", [2.0, 2.5, 10.0, 30.0])
def test_the_end_of_a_ride_is_seen_at_any_frame_rate(fps: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ekf_slam_node.odometry.inertial._MIN_JUDGED_STEPS", 10)
    (ride,) = driven(by_lift, 2, fps=fps).rides
    assert abs(ride.height - 9.0) < 3.5 * np.sqrt(ride.variance) < 1.0
    assert 1e-9 * ride.end_ns < STANDS + JOURNEY.wait + JOURNEY.seconds + 1.1


def test_a_ride_at_the_end_of_a_session_counts_if_its_cabin_stands() -> None:
    arrived = driven(by_lift, 1, seconds=STANDS + JOURNEY.wait + 9.3)
    assert arrived.aids.rides.is_riding
    ride = arrived.aids.rides.conclude()
    assert ride is not None
    assert abs(ride.height - 9.0) < 3.5 * np.sqrt(ride.variance) < 1.0
    on_the_way = driven(by_lift, 1, seconds=STANDS + JOURNEY.wait + 5.0)
    assert on_the_way.aids.rides.is_riding
    assert on_the_way.aids.rides.conclude() is None
    assert not on_the_way.aids.rides.is_riding
