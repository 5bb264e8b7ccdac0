# SPDX-License-Identifier: Apache-2.0
"""The IMU's filter: preintegration against the motion itself, honest states, darkness bridged, bad sensors left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imu_world import ACCELEROMETER_BIAS, GYRO_BIAS, PLACE, carried, imu_place, readings, velocity

from ekf_slam_node.config import EkfSlamConfig, InertialConfig, MotionConfig
from ekf_slam_node.odometry.odometry import OdometryChain, UpDirection
from ekf_slam_node.odometry.preintegration import ImuNoise, ImuReadings, Preintegral
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer
from ekf_slam_node.results import TrackingState
from ekf_slam_node.slam import EkfSlam
from feature_world import room
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    invert_transform,
    make_transform,
    so3_exp,
    so3_log,
)
from slam_core.types import ImuSample, PoseEstimate, Submap

STEP_NS = 100_000_000
NOISE = ImuNoise(3e-4, 3e-3, 1.0, 3.0)
SEEN = np.repeat([1.5e-3, 5e-4], 3)
"""Standard deviations (m, rad) of a motion that the images show."""
Z = np.array([0.0, 0.0, 1.0])


def buffer(samples: list[ImuSample]) -> ImuReadings:
    held = ImuReadings()
    for sample in samples:
        assert held.add(sample)
    return held


def integrated(samples: list[ImuSample], seconds: float, biases: FloatArray) -> Preintegral:
    pre = buffer(samples).integrate(0, round(seconds * 1e9), biases, NOISE)
    assert pre is not None
    return pre


def as_vector(pre: Preintegral, reference: Preintegral) -> FloatArray:
    return np.concatenate([so3_log(pre.R @ reference.R.T), pre.v - reference.v, pre.p - reference.p])


def test_preintegral_is_the_motion_without_velocity_and_gravity() -> None:
    biases = np.concatenate([GYRO_BIAS, ACCELEROMETER_BIAS])
    pre = integrated(readings(1.0, np.random.default_rng(0), 0.0, 0.0), 1.0, biases)
    R0, gravity = carried(0.0)[:3, :3], carried(0.0)[:3, :3].T @ [0.0, 0.0, -9.81]
    np.testing.assert_allclose(pre.R, R0.T @ carried(1.0)[:3, :3], atol=2e-5)
    way = R0.T @ (imu_place(1.0) - imu_place(0.0))
    np.testing.assert_allclose(velocity(0.0) + 0.5 * gravity + pre.p, way, atol=5e-4)
    end = R0.T @ carried(1.0)[:3, :3] @ velocity(1.0)
    np.testing.assert_allclose(velocity(0.0) + gravity + pre.v, end, atol=5e-4)


def test_preintegral_knows_its_errors() -> None:
    """Derivative by the biases against differences; covariance against fresh noise drawn many times."""
    samples = readings(0.5, np.random.default_rng(0), 0.0, 0.0)
    exact = integrated(samples, 0.5, np.zeros(6))
    for axis, step in enumerate(np.eye(6) * 1e-4):
        change = as_vector(integrated(samples, 0.5, step), exact) / 1e-4
        np.testing.assert_allclose(exact.J[:, axis], change, atol=0.02)
    longer = buffer(readings(1.0, np.random.default_rng(0), 0.0, 0.0))
    now, earlier = (longer.integrate(10**8 - t, 6 * 10**8 - t, np.zeros(6), NOISE) for t in (0, 10**6))
    assert now is not None
    assert earlier is not None
    np.testing.assert_allclose(now.J[:, 6], as_vector(earlier, now) / 1e-3, atol=0.02)
    rng, errors = np.random.default_rng(1), []
    for _ in range(300):
        noisy = [
            replace(
                s,
                angular_velocity=s.angular_velocity + 3e-3 * rng.standard_normal(3),
                linear_acceleration=s.linear_acceleration + 3e-2 * rng.standard_normal(3),
            )
            for s in samples
        ]
        errors.append(as_vector(integrated(noisy, 0.5, np.zeros(6)), exact))
    squared = np.mean([e @ np.linalg.solve(exact.covariance, e) for e in errors]) / 9
    assert 0.85 < squared < 1.1


def test_missing_readings_are_said_to_be_unknown() -> None:
    samples = readings(1.0, np.random.default_rng(0))
    with_gap = [s for s in samples if not 0.4e9 < s.stamp_ns < 0.7e9]
    whole, gap = integrated(samples, 1.0, np.zeros(6)), integrated(with_gap, 1.0, np.zeros(6))
    assert np.sqrt(gap.covariance[3, 3]) > 0.5 > 0.02 > np.sqrt(whole.covariance[3, 3])
    assert buffer(samples).integrate(0, 3 * 10**9, np.zeros(6), NOISE) is None
    assert not buffer(samples).add(samples[-1])


def followed(
    samples: list[ImuSample], seconds: float, rng: np.random.Generator, config: InertialConfig | None = None
) -> RelativePoseBuffer:
    """Aids that were told at 10 Hz of the motions that the images show."""
    aids = RelativePoseBuffer(MotionConfig(), config or InertialConfig())
    coming = iter(samples)
    for k in range(1, round(10 * seconds) + 1):
        while aids.newest_stamp_ns < k * STEP_NS - aids.time_offset_ns:
            aids.add_imu(next(coming))
        T = invert_transform(carried(0.1 * (k - 1))) @ carried(0.1 * k)
        aids.moved((k - 1) * STEP_NS, k * STEP_NS, boxplus(T, SEEN * rng.standard_normal(6)), np.diag(SEEN**2))
        aids.forget_before(k * STEP_NS)
    for sample in coming:
        aids.add_imu(sample)
    return aids


def test_states_become_known_and_stay_honest() -> None:
    values, claimed = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        aids = followed(readings(6.0, rng), 6.0, rng)
        truth = carried(6.0)
        error = np.concatenate(
            [
                aids.inertial.velocity - velocity(6.0),
                aids.inertial.gravity + 9.81 * truth[:3, :3].T @ Z,
                aids.inertial.biases - np.concatenate([GYRO_BIAS, ACCELEROMETER_BIAS]),
                [aids.inertial.time_offset],
            ]
        )
        values.append(error @ np.linalg.solve(aids.inertial.covariance, error) / 13)
        claimed.append(aids.inertial.sigma_tilt)
        assert aids.inertial.uses_force
    assert 0.2 < np.mean(values) < 1.3
    assert np.degrees(np.max(claimed)) < 0.4


@pytest.mark.parametrize("late_s", [0.02, -0.02])
def test_the_offset_of_a_clock_is_found_to_a_millisecond(late_s: float) -> None:
    errors, squared = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        samples = [replace(s, stamp_ns=s.stamp_ns - round(1e9 * late_s)) for s in readings(12.1, rng)]
        aids = followed(samples, 12.0, rng)
        errors.append(aids.inertial.time_offset - late_s)
        squared.append((errors[-1] / aids.inertial.sigma_time_offset) ** 2)
        assert aids.inertial.sigma_time_offset < 1e-3
    assert np.sqrt(np.mean(np.square(errors))) < 1e-3
    assert np.mean(squared) < 2.5
    exact = followed(samples, 4.0, np.random.default_rng(0), InertialConfig(sigma_time_offset=0.0))
    assert exact.inertial.time_offset == 0.0


def test_a_turn_that_the_images_tell_wrongly_does_not_move_the_clock() -> None:
    rng = np.random.default_rng(3)
    aids, coming = RelativePoseBuffer(MotionConfig(), InertialConfig()), iter(readings(6.0, rng))
    for k in range(1, 51):
        while aids.newest_stamp_ns < k * STEP_NS:
            aids.add_imu(next(coming))
        T = invert_transform(carried(0.1 * (k - 1))) @ carried(0.1 * k)
        error = SEEN * rng.standard_normal(6) + (k == 12) * np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.1])
        aids.moved((k - 1) * STEP_NS, k * STEP_NS, boxplus(T, error), np.diag(SEEN**2))
        assert abs(aids.inertial.time_offset) < 3e-3
    assert aids.inertial.sigma_time_offset < 1.1e-3


def test_three_seconds_are_bridged_within_what_is_claimed() -> None:
    errors, values = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        aid = followed(readings(11.0, rng), 8.0, rng).bridge(8 * 10**9, 11 * 10**9)
        assert aid is not None
        error = boxminus(invert_transform(carried(8.0)) @ carried(11.0), aid.T)
        errors.append(np.linalg.norm(error[:3]))
        values.append(error @ np.linalg.solve(aid.covariance, error) / 6)
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
    assert 0.1 < np.mean(values) < 1.3


@pytest.mark.parametrize(
    ("turned", "said"),
    [
        (np.eye(3) / 9.81, "gravity has 9.81"),
        (np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "contradicts the images"),
        (np.zeros((3, 3)), ""),
    ],
)
def test_an_accelerometer_that_reads_something_else_is_left_out(turned: FloatArray, said: str) -> None:
    rng = np.random.default_rng(3)
    wrong = [replace(s, linear_acceleration=turned @ s.linear_acceleration) for s in readings(8.0, rng)]
    aids = followed(wrong, 7.0, rng)
    assert not aids.inertial.uses_force
    assert said in aids.inertial.diagnostic
    assert (said == "") == (aids.inertial.diagnostic == "")
    assert aids.bridge(7 * 10**9, 8 * 10**9) is None
    np.testing.assert_allclose(aids.inertial.biases[:3], GYRO_BIAS, atol=2e-3)


def test_an_imu_along_other_axes_is_left_out() -> None:
    """Mounted upside down, and nobody has said so: it turns the other way."""
    rng, over = np.random.default_rng(3), np.diag([1.0, -1.0, -1.0])
    aids = followed([s.seen_from(make_transform(over, np.zeros(3)), "base_link") for s in readings(8.0, rng)], 6.0, rng)
    assert "turn rates contradict the images" in aids.inertial.diagnostic
    assert aids.between(60 * STEP_NS, 61 * STEP_NS) is None
    assert aids.up is None


def through_darkness(imu: str) -> tuple[list[Submap], list[TrackingState], float]:
    """A walk round a room, three seconds of it dark; the error of the last pose, m."""
    rng = np.random.default_rng(7)
    world, samples = room(rng), iter(readings(12.0, rng))
    config = EkfSlamConfig()
    slam, stamp = EkfSlam(replace(config, imu=replace(config.imu, use=imu))), -1
    states: list[TrackingState] = []
    submaps: list[Submap] = []
    for k in range(101):
        while stamp < k * STEP_NS:
            sample = next(samples)
            stamp = sample.stamp_ns
            slam.process_imu(sample)
        features, _ = world.features(carried(0.1 * k), k * STEP_NS, rng, max_features=80)
        dark = features.select(np.zeros(0, dtype=np.int64))
        result = slam.process(dark if 60 <= k < 90 else features)
        states.append(result.state)
        submaps += result.submaps
    error = boxminus(invert_transform(carried(0.0)) @ carried(10.0), result.pose.T)
    assert ("gaps_bridged" in slam.counters.counts) == (imu != "off")
    return [*submaps, *slam.finish()], states, float(np.linalg.norm(error[:3]))


def test_the_map_goes_on_after_three_seconds_of_darkness() -> None:
    submaps, states, error = through_darkness("auto")
    assert set(states[60:90]) == {TrackingState.DEGRADED}
    assert set(states[92:]) == {TrackingState.OK}
    assert error < 0.1
    assert [s.follows_previous for s in submaps[1:]] == [True] * (len(submaps) - 1)
    ends = [s.path[-1].stamp_ns for s in submaps]
    before = ends.index(90 * STEP_NS)  # what is known of old landmarks from behind a gap is no good for a gate
    assert not set(submaps[before].landmark_ids) & set(submaps[before + 1].landmark_ids)
    path = {pose.stamp_ns: pose for submap in submaps for pose in submap.path}
    assert all(k * STEP_NS in path for k in range(101))
    widest = max(np.trace(path[k * STEP_NS].covariance[:3, :3]) for k in range(60, 90))
    assert widest > 4.0 * np.trace(path[59 * STEP_NS].covariance[:3, :3])


def test_without_the_imu_darkness_is_the_end_of_the_map() -> None:
    submaps, states, error = through_darkness("off")
    assert set(states[60:90]) == {TrackingState.LOST}
    assert error > 0.3
    assert False in [s.follows_previous for s in submaps[1:]]


@pytest.mark.parametrize("imu", ["auto", "off"])
def test_a_place_that_looks_like_another_is_told_from_it_by_the_imu(imu: str) -> None:
    """Nothing is seen for two seconds, a quarter of a turn; then the view of 2.3 s ago."""
    rng = np.random.default_rng(7)
    world, samples = room(rng), iter(readings(9.0, rng))
    config = EkfSlamConfig()
    slam, stamp = EkfSlam(replace(config, imu=replace(config.imu, use=imu))), -1
    for k in (*range(60), 80):
        while stamp < k * STEP_NS:
            sample = next(samples)
            stamp = sample.stamp_ns
            slam.process_imu(sample)
        features, _ = world.features(carried(5.7 if k == 80 else 0.1 * k), k * STEP_NS, rng, max_features=80)
        result = slam.process(features)
    assert (result.state is TrackingState.OK) == (imu == "off")
    assert (slam.counters.counts.get("links_refuted", 0) > 0) == (imu != "off")


def test_an_imu_refutes_a_few_frames_in_a_row_and_no_more() -> None:
    aids = followed(readings(8.0, np.random.default_rng(3)), 6.0, np.random.default_rng(4))
    aside = make_transform(so3_exp(0.5 * Z), np.zeros(3))
    refuted = [aids.is_inconsistent(60 * STEP_NS, k * STEP_NS, aside, 1e-6 * np.eye(6)) for k in range(61, 71)]
    assert refuted == [True] * sum(refuted) + [False] * (10 - sum(refuted))
    assert 1 <= sum(refuted) <= 4


def test_gravity_holds_roll_and_pitch_of_a_long_chain() -> None:
    """Submaps whose ends are tilted at random: without gravity the errors add up."""
    rng, drift = np.random.default_rng(5), np.repeat([0.002, np.radians(0.1)], 3)
    chains, truth = (OdometryChain(), OdometryChain()), np.eye(4)
    step = make_transform(so3_exp(np.array([0.0, 0.0, 0.3])), np.array([1.0, 0.0, 0.0]))
    tilted, spread = so3_exp(np.array([0.1, -0.2, 0.0])), np.radians(0.05)
    errors = []
    for k in range(1, 61):
        truth = truth @ step
        seen = boxplus(step, drift * rng.standard_normal(6))
        up = truth[:3, :3].T @ tilted @ Z
        read = so3_exp(spread * rng.standard_normal(3)) @ up
        levelled = UpDirection(read, spread**2 * (np.eye(3) - np.outer(read, read)))
        for chain, gravity in zip(chains, (levelled, None), strict=True):
            stamp = 20 * k * 10**9
            chain.advance(chain.pose(stamp, seen, np.diag(drift**2)), gravity)
        errors.append([np.degrees(np.linalg.norm(np.cross(chain_up(c, truth), Z))) for c in chains])
    with_gravity, without = np.sqrt(np.mean(np.square(errors[20:]), axis=0))
    assert with_gravity < 0.2 < 0.5 < without
    end: PoseEstimate = chains[0].pose(0, np.eye(4), 1e-12 * np.eye(6))
    error = boxminus(truth, end.T)
    assert error @ np.linalg.solve(end.covariance, error) / 6 < 2.5


def chain_up(chain: OdometryChain, truth: FloatArray) -> FloatArray:
    """The true vertical of the odom frame as the chain's pose has it."""
    T = chain.pose(0, np.eye(4), np.zeros((6, 6))).T
    return np.asarray(T[:3, :3] @ truth[:3, :3].T @ Z)


def test_place_of_the_imu_is_taken_into_account() -> None:
    """A rig that turns about its own origin moves its IMU on an arc."""
    assert np.linalg.norm(PLACE) > 0.1
    rng = np.random.default_rng(1)
    samples = readings(11.0, rng)
    right = followed(samples, 8.0, rng).bridge(8 * 10**9, 11 * 10**9)
    moved = [replace(s, position=PLACE + 0.5 * np.eye(3)[1]) for s in samples]
    wrong = followed(moved, 8.0, rng).bridge(8 * 10**9, 11 * 10**9)
    truth = invert_transform(carried(8.0)) @ carried(11.0)
    assert right is not None
    assert np.linalg.norm(boxminus(truth, right.T)[:3]) < 0.1
    assert wrong is None or np.linalg.norm(boxminus(truth, wrong.T)[:3]) > 0.2
