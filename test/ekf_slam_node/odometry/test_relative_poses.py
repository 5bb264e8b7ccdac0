# SPDX-License-Identifier: Apache-2.0
"""Motion from scans and turn rates from an IMU: chained, interpolated, gated, and worth what they claim."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig, InertialConfig, MotionConfig
from ekf_slam_node.odometry.relative_poses import ALL, MEAN_TURN_RATE_SIGMA, ROTATION, RelativePoseBuffer
from ekf_slam_node.results import TrackingState
from ekf_slam_node.slam import EkfSlam
from feature_world import loop, room
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform, so3_exp, so3_log
from slam_core.types import ImuSample, RelativeMotion

STEP_NS = 100_000_000
COVARIANCE = np.diag(np.repeat([0.003, 0.002], 3) ** 2)


def motion(poses: list[FloatArray], k: int, error: FloatArray | None = None) -> RelativeMotion:
    T = invert_transform(poses[k - 1]) @ poses[k]
    return RelativeMotion(
        (k - 1) * STEP_NS, k * STEP_NS, boxplus(T, np.zeros(6) if error is None else error), COVARIANCE
    )


def test_motions_are_chained_over_several_scans() -> None:
    poses, aids = loop(10), RelativePoseBuffer(MotionConfig())
    for k in range(1, 6):
        assert aids.add_motion(motion(poses, k))
    aid = aids.between(0, 5 * STEP_NS)
    assert aid is not None
    assert aid.rows == ALL
    np.testing.assert_allclose(aid.T, invert_transform(poses[0]) @ poses[5], atol=1e-12)
    assert np.trace(aid.covariance) > 4.0 * np.trace(COVARIANCE)


def test_scan_of_another_stamp_is_interpolated_and_goes_on_for_a_while() -> None:
    poses, aids = loop(20), RelativePoseBuffer(MotionConfig())
    for k in range(1, 4):
        aids.add_motion(motion(poses, k))
    inside = aids.between(STEP_NS // 2, 2 * STEP_NS)
    beyond = aids.between(STEP_NS, 3 * STEP_NS + STEP_NS // 2)
    assert inside is not None
    assert beyond is not None
    assert np.linalg.norm(inside.T[:3, 3]) == pytest.approx(1.5 * np.linalg.norm(motion(poses, 1).T[:3, 3]), rel=0.02)
    assert np.trace(beyond.covariance) > 10.0 * np.trace(COVARIANCE)
    assert aids.between(0, 5 * STEP_NS) is None


def test_unusable_motions_are_refused() -> None:
    aids = RelativePoseBuffer(MotionConfig())
    assert not aids.add_motion(RelativeMotion(0, 1, np.full((4, 4), np.nan), COVARIANCE))
    assert not aids.add_motion(RelativeMotion(0, 1, np.eye(4), -COVARIANCE))
    assert not aids.add_motion(RelativeMotion(1, 1, np.eye(4), COVARIANCE))
    assert not aids.add_imu(ImuSample(0, np.array([np.nan, 0, 0]), np.zeros(3)))


def test_turn_rates_are_integrated() -> None:
    aids = RelativePoseBuffer(MotionConfig())
    rate = np.array([0.1, -0.4, 0.8])
    for k in range(-1, 25):
        aids.add_imu(ImuSample(k * 5_000_000, rate, np.zeros(3)))
    aid = aids.between(2_000_000, 102_000_000)
    assert aid is not None
    assert aid.rows == ROTATION
    np.testing.assert_allclose(so3_log(aid.T[:3, :3]), 0.1 * rate, atol=1e-9)
    assert aids.between(0, 10**9) is None


def test_constant_error_of_turn_rates_is_learnt() -> None:
    """From the turns that the images show; one that has nothing to do with it is left out."""
    config, rng, dt = MotionConfig(), np.random.default_rng(3), 0.1
    aids, bias, seen = (
        RelativePoseBuffer(config),
        np.array([0.01, -0.02, 0.005]),
        np.diag(np.repeat([1e-3, 5e-4], 3) ** 2),
    )
    turn = np.array([0.3, 0.1, -0.6])
    for k in range(200):
        for part in range(11):
            aids.add_imu(ImuSample((10 * k + part) * STEP_NS // 10 + 1, turn + bias, np.zeros(3)))
        aid = aids.between(k * STEP_NS, (k + 1) * STEP_NS)
        assert aid is not None
        sudden = np.array([0.2, 0.0, 0.0]) if k == 150 else np.zeros(3)
        shown = make_transform(so3_exp(turn * dt + sudden + 5e-4 * rng.standard_normal(3)), np.zeros(3))
        aids.moved(k * STEP_NS, (k + 1) * STEP_NS, shown, seen)
        aids.forget_before(k * STEP_NS)
    aid = aids.between(199 * STEP_NS, 200 * STEP_NS)
    assert aid is not None
    error = so3_log(aid.T[:3, :3]) / dt - turn
    claimed = np.sqrt(aid.covariance.diagonal() / dt**2 - MEAN_TURN_RATE_SIGMA**2)
    assert (np.abs(error) < 3.0 * claimed).all()
    assert (claimed < 0.1 * InertialConfig().gyroscope_bias).all()


def test_biased_turn_rates_do_not_turn_the_map() -> None:
    """Once round a room, with a gyroscope that is off by 2 degrees per second and with an exact one."""
    ends = []
    for bias in (np.zeros(3), np.array([0.0, 0.035, 0.0])):
        rng = np.random.default_rng(5)
        world, poses, slam = room(rng), loop(80), EkfSlam(EkfSlamConfig())
        for k, T in enumerate(poses):
            if k:
                rate = so3_log(poses[k - 1][:3, :3].T @ T[:3, :3]) / 0.1 + bias
                for part in range(10):
                    slam.process_imu(ImuSample((k - 1) * STEP_NS + part * STEP_NS // 10 + 1, rate, np.zeros(3)))
            result = slam.process(world.features(T, k * STEP_NS, rng, max_features=60)[0])
        ends.append(result.pose.T)
    assert np.degrees(np.linalg.norm(boxminus(*ends)[3:])) < 0.3


def run(aided: str, steps: int = 30) -> tuple[EkfSlam, list[float]]:
    """NEES of the last pose over runs with noisy aids."""
    values = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        world, poses = room(rng, 700), loop(steps)
        slam = EkfSlam(EkfSlamConfig())
        for k, T in enumerate(poses):
            if k and aided == "motion":
                slam.process_motion(motion(poses, k, np.sqrt(np.diag(COVARIANCE)) * rng.standard_normal(6)))
            if k and aided == "imu":
                step = so3_log(poses[k - 1][:3, :3].T @ T[:3, :3]) / 0.1
                noisy = step + MEAN_TURN_RATE_SIGMA * rng.standard_normal(3)
                for part in range(10):
                    slam.process_imu(ImuSample((k - 1) * STEP_NS + part * STEP_NS // 10 + 1, noisy, np.zeros(3)))
            result = slam.process(world.features(T, k * STEP_NS, rng, max_features=40)[0])
        error = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
        values.append(float(error @ np.linalg.solve(result.pose.covariance, error)) / 6)
    return slam, values


@pytest.mark.parametrize("aided", ["motion", "imu"])
def test_aided_filter_stays_honest(aided: str) -> None:
    slam, values = run(aided)
    assert slam.counters.counts["aids_used"] >= 25
    assert 0.5 < np.mean(values) < 1.6


def test_odometry_carries_the_rig_through_darkness(rng: np.random.Generator) -> None:
    world, poses, slam = room(rng), loop(40), EkfSlam(EkfSlamConfig())
    states = []
    for k, T in enumerate(poses):
        features, _ = world.features(T, k * STEP_NS, rng)
        dark = features.select(np.zeros(0, dtype=np.int64))
        result = slam.process(dark if 15 <= k < 25 else features, motion(poses, k) if k else None)
        states.append(result.state)
    assert states[15:25] == [TrackingState.DEGRADED] * 10
    assert states[26:] == [TrackingState.OK] * 14
    error = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
    assert np.linalg.norm(error[:3]) < 0.08


def test_wrong_odometry_is_rejected(rng: np.random.Generator) -> None:
    world, poses, slam = room(rng), loop(30), EkfSlam(EkfSlamConfig())
    for k, T in enumerate(poses):
        wild = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3]) if k == 20 else None
        result = slam.process(world.features(T, k * STEP_NS, rng)[0], motion(poses, k, wild) if k else None)
    assert slam.counters.counts["aids_rejected"] == 1
    error = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
    assert np.linalg.norm(error[:3]) < 0.06
    assert np.linalg.norm(so3_exp(error[3:]) - np.eye(3)) < 0.05
