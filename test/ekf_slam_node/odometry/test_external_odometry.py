# SPDX-License-Identifier: Apache-2.0
"""Wheels and other odometry: honest about where they lead, calibrated by the images, slip gated, darkness bridged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from imu_world import carried, readings

from ekf_slam_node.config import EkfSlamConfig, ExternalOdometryConfig, InertialConfig, MotionConfig
from ekf_slam_node.odometry.external_odometry import ExternalOdometry, calibrated
from ekf_slam_node.odometry.pose_readings import PoseReadings
from ekf_slam_node.odometry.preintegration import Preintegral
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer
from ekf_slam_node.results import TrackingState
from ekf_slam_node.slam import EkfSlam
from feature_world import room
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform, so3_exp
from slam_core.types import OdometryReading
from slam_simulation.sensors.wheels import WheelSensor, WheelSensorConfig
from slam_simulation.trajectory import MOTION_STYLES, SplinePath

STEP_S, STEP_NS = 0.1, 100_000_000
SEEN = np.diag(np.repeat([0.002, np.radians(0.1)], 3) ** 2)
"""Covariance of a motion that the images show."""
LEARNT_S, END_S = 16.0, 22.0
RADIUS, YAW = 0.02, np.radians(1.0)
PLANAR = [0, 1, 5]
GOOD = WheelSensorConfig(radius_error=RADIUS, yaw_error_deg=1.0)


def no_turns(start_ns: int, end_ns: int) -> Preintegral | None:
    return None


@cache
def drive(seed: int) -> SplinePath:
    """A winding way over a floor."""
    rng = np.random.default_rng(seed)
    points = np.zeros((9, 5))
    points[:, 2], points[:, 3] = 1.2, np.cumsum(rng.uniform(-1.0, 1.0, 9))
    ahead = np.column_stack([np.cos(points[:-1, 3]), np.sin(points[:-1, 3])])
    points[1:, :2] = np.cumsum(ahead, axis=0)
    return SplinePath(points, END_S, MOTION_STYLES["rig"], rng)


def wheel_readings(config: WheelSensorConfig, seed: int) -> tuple[OdometryReading, ...]:
    return WheelSensor(config, drive(seed), 1.2, (seed, 3)).read(-1.0, END_S, 0)


def learnt(poses: tuple[OdometryReading, ...], seed: int) -> ExternalOdometry:
    """An odometry beside images that see the drive for a while."""
    odometry, rng = ExternalOdometry(ExternalOdometryConfig()), np.random.default_rng(seed + 100)
    assert {odometry.add(pose) for pose in poses} == {""}
    stamps = np.arange(0, round(LEARNT_S * 1e9) + 1, STEP_NS)
    for start, end in pairwise(stamps.tolist()):
        seen = boxplus(motion(seed, start, end), rng.multivariate_normal(np.zeros(6), SEEN))
        odometry.learn(start, end, seen, SEEN)
    return odometry


def motion(seed: int, start_ns: int, end_ns: int) -> FloatArray:
    return invert_transform(drive(seed).pose(start_ns * 1e-9)) @ drive(seed).pose(end_ns * 1e-9)


def nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def errors(config: WheelSensorConfig) -> tuple[float, float]:
    """Mean NEES over some drives: of the calibration, and of the planar motion reckoned from there on."""
    of_calibration, of_motion = [], []
    truth = np.array([1.0 / (1.0 + config.radius_error) - 1.0, 0.0, np.radians(config.yaw_error_deg)])
    for seed in range(10):
        odometry = learnt(wheel_readings(config, seed), seed)
        of_calibration.append(nees(odometry.calibration - truth, odometry.covariance))
        start, end = round(LEARNT_S * 1e9), round(END_S * 1e9) - STEP_NS
        reckoned = odometry.reckon(start, end, no_turns)
        assert reckoned is not None
        error = boxminus(motion(seed, start, end), reckoned.T)[PLANAR]
        of_motion.append(nees(error, reckoned.covariance[np.ix_(PLANAR, PLANAR)]))
    return float(np.mean(of_calibration)), float(np.mean(of_motion))


def test_radius_and_mounting_are_learnt_and_the_way_is_known_as_well_as_claimed() -> None:
    of_calibration, of_motion = errors(GOOD)
    assert 0.3 < of_calibration < chi_square_bound(0.999, 30) / 30
    assert 0.15 < of_motion < chi_square_bound(0.999, 30) / 30


def test_the_scale_is_worth_its_learning() -> None:
    odometry = learnt(wheel_readings(GOOD, 0), 0)
    sigma = np.sqrt(np.diagonal(odometry.covariance))
    assert sigma[0] < 0.3 * ExternalOdometryConfig().sigma_scale
    assert abs(odometry.calibration[0] + RADIUS) < 0.5 * RADIUS
    assert "way x 0.98" in odometry.finding


def test_without_a_covariance_the_images_tell_the_noise() -> None:
    of_calibration, of_motion = errors(replace(GOOD, claims_covariance=False))
    assert of_calibration < 2.0
    assert of_motion < 2.0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9, -1.0])
def test_a_covariance_that_cannot_be_meant_is_none(value: float) -> None:
    silent, strange = PoseReadings(), PoseReadings()
    for pose in wheel_readings(replace(GOOD, claims_covariance=False), 0):
        assert silent.add(pose) == ""
        assert strange.add(replace(pose, covariance=value * np.eye(6), twist_covariance=value * np.eye(6))) == ""
    assert not strange.claimed.any()
    np.testing.assert_array_equal(strange.motion(0, 10**10)[1], silent.motion(0, 10**10)[1])


def test_of_the_noise_that_the_images_tell_the_size_follows_the_slip() -> None:
    silent = replace(GOOD, claims_covariance=False)
    smooth, slippery = (learnt(wheel_readings(replace(silent, slip=slip), 1), 1) for slip in (0.002, 0.05))
    assert slippery.noise[5] > 5.0 * smooth.noise[5]
    assert "no usable covariance of x, y, z, roll, pitch, yaw" in smooth.estimated
    assert "of z, roll, pitch:" in learnt(wheel_readings(GOOD, 1), 1).estimated


def test_wheels_that_spin_are_counted_and_teach_nothing() -> None:
    """For a second and a half they turn a third more than the rig moves."""
    odometry, truthful = (ExternalOdometry(ExternalOdometryConfig()) for _ in range(2))
    rng, T = np.random.default_rng(0), np.eye(4)
    poses = wheel_readings(replace(GOOD, radius_error=0.0, yaw_error_deg=0.0), 2)
    for before, now in pairwise((poses[0], *poses)):
        step = invert_transform(before.T) @ now.T
        if 8.0 < now.stamp_ns * 1e-9 < 9.5:
            step[:3, 3] *= 1.35
        T = T @ step
        odometry.add(replace(now, T=T))
        truthful.add(now)
    for start, end in pairwise(range(0, round(LEARNT_S * 1e9) + 1, STEP_NS)):
        seen = boxplus(motion(2, start, end), rng.multivariate_normal(np.zeros(6), SEEN))
        odometry.learn(start, end, seen, SEEN)
        truthful.learn(start, end, seen, SEEN)
    assert truthful.slips == 0
    assert odometry.slips in (1, 2)
    assert abs(odometry.calibration[0]) < 3.0 * np.sqrt(odometry.covariance[0, 0])


def test_a_gyroscope_tells_slip_in_the_dark() -> None:
    """The wheels report a turn that the gyroscope has not felt: its turn counts, and the way is not known as well."""
    poses = [
        OdometryReading(
            k * STEP_NS,
            make_transform(so3_exp(np.array([0.0, 0.0, turn])), np.array([0.05 * k, 0.0, 0.0])),
            1e-6 * (k + 1) * np.eye(6),
            np.zeros(6),
            np.zeros((6, 6)),
        )
        for k, turn in enumerate([0.0, 0.0, 0.5])
    ]
    found = {}
    for name, end in (("straight", 1), ("slip", 2)):
        odometry = ExternalOdometry(ExternalOdometryConfig())
        for pose in poses:
            odometry.add(pose)
        still = Preintegral(
            0.1,
            np.eye(3),
            np.zeros(3),
            np.zeros(3),
            np.zeros((9, 7)),
            np.zeros((2, 3)),
            1e-6 * np.eye(9),
            np.zeros(3),
            9.8,
        )
        reckoned = odometry.reckon((end - 1) * STEP_NS, end * STEP_NS, lambda start, end, still=still: still)  # type: ignore[misc]
        assert reckoned is not None
        np.testing.assert_allclose(reckoned.T[:3, :3], np.eye(3), atol=1e-12)
        found[name] = odometry.slips, float(reckoned.covariance[0, 0])
    assert found["straight"][0] == 0
    assert found["slip"][0] == 1
    assert found["slip"][1] > 10.0 * found["straight"][1]


def test_calibrated_steps_know_their_derivative() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        T = make_transform(so3_exp(0.2 * rng.standard_normal(3)), 0.1 * rng.standard_normal(3))
        c = 0.1 * rng.standard_normal(3)
        exact, J = calibrated(T, c)
        for axis, step in enumerate(1e-6 * np.eye(3)):
            change = boxminus(calibrated(T, c + step)[0], calibrated(T, c - step)[0]) / 2e-6
            np.testing.assert_allclose(J[:, axis], change, atol=1e-7)
        assert np.isfinite(exact).all()


def test_poses_of_no_use_are_rejected_with_a_reason() -> None:
    odometry, good = ExternalOdometry(ExternalOdometryConfig()), wheel_readings(GOOD, 0)
    assert odometry.add(replace(good[0], T=np.full((4, 4), np.nan))) == "not finite"
    assert [odometry.add(pose) for pose in good[:3]] == [""] * 3
    assert odometry.add(good[1]) == "not newer than the last"
    far = make_transform(np.eye(3), np.array([50.0, 0.0, 0.0]))
    assert odometry.add(replace(good[3], T=far)) == "jumped"
    assert odometry.add(replace(good[4], T=far)) == ""
    assert not odometry.readings.covers(good[2].stamp_ns, good[4].stamp_ns)
    assert odometry.reckon(good[2].stamp_ns, good[4].stamp_ns, no_turns) is None
    assert odometry.add(replace(good[80], T=far)) == ""  # a gap
    assert not odometry.readings.covers(good[4].stamp_ns, good[80].stamp_ns)


def test_an_odometry_along_other_axes_counts_for_little_and_says_so() -> None:
    """Its frame looks back, and nobody has said so."""
    back = make_transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    poses = tuple(replace(p, T=p.T @ back) for p in wheel_readings(GOOD, 3))
    assert "contradicts the images" in learnt(poses, 3).diagnostic
    assert learnt(wheel_readings(GOOD, 3), 3).diagnostic == ""


def test_images_that_see_again_correct_what_was_bridged() -> None:
    """The joint covariance of two moments is that of the steps between them."""
    odometry = learnt(wheel_readings(GOOD, 4), 4)
    start = round(LEARNT_S * 1e9)
    early = odometry.reckon(start, start + 10 * STEP_NS, no_turns)
    late = odometry.reckon(start, start + 40 * STEP_NS, no_turns)
    assert early is not None
    assert late is not None
    cross = late.covariance_with(early)
    assert cross is not None
    np.testing.assert_allclose(early.covariance_with(early), early.covariance[:6, :6], atol=1e-12)
    joint = np.block([[early.covariance[:6, :6], cross], [cross.T, late.covariance[:6, :6]]])
    values = np.linalg.eigvalsh(joint)
    assert values[0] > -1e-12
    assert early.covariance_with(None) is None


def pose_readings(seconds: float, rng: np.random.Generator, factor: float = 1.0) -> list[OdometryReading]:
    """Another estimator on the walk of ``imu_world``, whose way is too long by a factor: its noise is as it claims."""
    T, covariance, poses = np.eye(4), np.zeros((6, 6)), []
    noise = np.diag(np.repeat([3e-4, 2e-4], 3) ** 2)
    for k in range(round(50 * seconds) + 1):
        poses.append(OdometryReading(20_000_000 * k, T, covariance + 1e-12 * np.eye(6), np.zeros(6), np.zeros((6, 6))))
        step = boxplus(
            invert_transform(carried(0.02 * k)) @ carried(0.02 * (k + 1)), rng.multivariate_normal(np.zeros(6), noise)
        )
        step[:3, 3] *= factor
        T, covariance = T @ step, covariance + noise
    return poses


@pytest.mark.parametrize("with_imu", [False, True])
def test_the_map_goes_on_after_darkness(with_imu: bool) -> None:
    rng = np.random.default_rng(7)
    world, waiting, samples = room(rng), pose_readings(14.0, rng, 1.02), readings(14.0, rng)
    slam, submaps, states, poses = EkfSlam(EkfSlamConfig()), [], [], []
    for k in range(131):
        while waiting and waiting[0].stamp_ns <= k * STEP_NS:
            slam.process_odometry(waiting.pop(0))
        while with_imu and samples[0].stamp_ns <= k * STEP_NS:
            slam.process_imu(samples.pop(0))
        features, _ = world.features(carried(0.1 * k), k * STEP_NS, rng, max_features=80)
        dark = features.select(np.zeros(0, dtype=np.int64))
        result = slam.process(dark if 50 <= k < 120 else features)
        states.append(result.state)
        submaps += result.submaps
        poses.append(result.pose)
    submaps += slam.finish()
    assert set(states[50:120]) == {TrackingState.DEGRADED}
    assert set(states[122:]) == {TrackingState.OK}
    assert [s.follows_previous for s in submaps[1:]] == [True] * (len(submaps) - 1)
    assert sum(len(s.path) - 1 for s in submaps) == 130  # every frame is in a submap
    way = sum(float(np.linalg.norm(carried(0.1 * k + 0.1)[:3, 3] - carried(0.1 * k)[:3, 3])) for k in range(50, 120))
    for pose in (poses[119], poses[-1]):
        error = boxminus(invert_transform(carried(0.0)) @ carried(pose.stamp_ns * 1e-9), pose.T)
        assert np.linalg.norm(error[:3]) < 0.01 * way
        assert nees(error, pose.covariance) < 3.0
    for submap in submaps:
        for pose in submap.path:
            T = invert_transform(carried(submap.start_stamp_ns * 1e-9)) @ carried(pose.stamp_ns * 1e-9)
            assert np.linalg.eigvalsh(pose.covariance)[0] > 0.0
            assert nees(boxminus(T, pose.T), pose.covariance + 1e-10 * np.eye(6)) < 6.0


def test_an_imu_does_not_condemn_and_the_odometry_is_taken_first() -> None:
    aids = RelativePoseBuffer(MotionConfig(), InertialConfig(), ExternalOdometryConfig())
    for pose in pose_readings(1.0, np.random.default_rng(0)):
        assert aids.add_odometry(pose) == ""
    aid = aids.bridge(0, 5 * STEP_NS)
    assert aid is not None
    assert aid.source == "odometry"
    assert aids.bridge(0, 50 * STEP_NS) is None
    velocity, sigma = aids.velocity()
    np.testing.assert_allclose(velocity[:3], (invert_transform(carried(0.9)) @ carried(1.0))[:3, 3] / 0.1, atol=0.05)
    assert (sigma > 0.0).all()


def test_slip_is_among_the_filters_counts() -> None:
    """For two seconds the way that is reported is half as long again."""
    rng = np.random.default_rng(7)
    world, slam = room(rng), EkfSlam(EkfSlamConfig())
    T, poses = np.eye(4), pose_readings(8.0, rng)
    for before, now in pairwise((poses[0], *poses)):
        step = invert_transform(before.T) @ now.T
        step[:3, 3] *= 1.5 if 4.0 < now.stamp_ns * 1e-9 < 6.0 else 1.0
        T = T @ step
        slam.process_odometry(replace(now, T=T))
    slam.process_odometry(replace(poses[-1], T=T))
    for k in range(70):
        slam.process(world.features(carried(0.1 * k), k * STEP_NS, rng, max_features=80)[0])
    counts = slam.counters.counts
    assert counts["odometry_slips"] >= 1
    assert counts["odometry_not_newer_than_the_last"] == 1


def test_a_run_that_ends_in_the_dark_keeps_its_way() -> None:
    rng = np.random.default_rng(7)
    world, slam, waiting = room(rng), EkfSlam(EkfSlamConfig()), pose_readings(10.0, rng)
    submaps = []
    for k in range(80):
        while waiting[0].stamp_ns <= k * STEP_NS:
            slam.process_odometry(waiting.pop(0))
        features, _ = world.features(carried(0.1 * k), k * STEP_NS, rng, max_features=80)
        submaps += slam.process(features if k < 50 else features.select(np.zeros(0, dtype=np.int64))).submaps
    submaps += slam.finish()
    assert sum(len(s.path) - 1 for s in submaps) == 79
    last = submaps[-1]
    true = invert_transform(carried(last.start_stamp_ns * 1e-9)) @ carried(7.9)
    assert last.end_stamp_ns == 79 * STEP_NS
    assert nees(boxminus(true, last.end_pose), last.path[-1].covariance) < 4.0


def test_in_the_dark_old_readings_are_forgotten_and_the_way_is_the_same() -> None:
    """A rig asked for its place ten times a second, and one asked once at the end, whose readings are all there."""
    poses = wheel_readings(GOOD, 5)
    often, once = ExternalOdometry(ExternalOdometryConfig()), ExternalOdometry(ExternalOdometryConfig())
    for pose in poses:
        often.add(pose)
        once.add(pose)
        if pose.stamp_ns % STEP_NS == 0 and pose.stamp_ns:
            reckoned = often.reckon(0, pose.stamp_ns, no_turns)
    assert once.readings.covers(0, poses[-1].stamp_ns)
    whole = once.reckon(0, reckoned.stamp_ns, no_turns)
    assert not often.readings.covers(0, poses[-1].stamp_ns)
    np.testing.assert_allclose(reckoned.T, whole.T, atol=1e-9)
    np.testing.assert_allclose(reckoned.covariance, whole.covariance, rtol=1e-6, atol=1e-12)
    before = often.reckon(0, reckoned.stamp_ns - STEP_NS, no_turns)  # the frame before turns out to be of use
    assert before is not None
    assert before.stamp_ns == reckoned.stamp_ns - STEP_NS
