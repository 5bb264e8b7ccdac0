# SPDX-License-Identifier: Apache-2.0
"""The filter of pose and velocity: honest over many runs, blind directions filled by the prediction, exact limits."""

from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.motion_filter import MotionFilter, MotionFilterConfig, rotated
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform, rotation_from_euler

CONFIG = MotionFilterConfig(
    acceleration_sigma=0.5, angular_acceleration_sigma=0.5, speed_sigma=0.3, angular_speed_sigma=0.3
)
DT = 0.1
SIGMA = np.repeat([0.004, 0.002], 3)
BLIND = np.array([1.0, 0.0, 0.0])
"""Direction, along the axes of the odometry's frame, in which the measured poses of some tests say nothing."""


def drive(rng: np.random.Generator, steps: int) -> list[FloatArray]:
    """Poses by white acceleration, the velocity along the sensor's axes."""
    poses, velocity = [np.eye(4)], rng.normal(size=6) * 0.3
    for _ in range(steps):
        acceleration = rng.normal(size=6) * 0.5
        poses.append(poses[-1] @ boxplus(np.eye(4), DT * velocity + 0.5 * DT**2 * acceleration))
        velocity = velocity + DT * acceleration
    return poses


def measured(T: FloatArray, rng: np.random.Generator, blind_sigma: float) -> tuple[FloatArray, FloatArray]:
    """A noisy pose and its covariance, with ``blind_sigma`` m along BLIND."""
    sigma = SIGMA + np.r_[blind_sigma * BLIND, np.zeros(3)]
    return boxplus(T, rng.normal(size=6) * sigma), np.diag(sigma**2)


@pytest.mark.parametrize("blind_sigma", [0.0, 1.0])
def test_fused_motions_are_as_uncertain_as_they_claim(blind_sigma: float) -> None:
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, filtered = drive(rng, 6), MotionFilter(CONFIG)
        for pose in poses[1:]:
            filtered.predict(DT)
            filtered.fuse(*measured(pose, rng, blind_sigma))
        T, covariance = filtered.motion()
        d = boxminus(T, invert_transform(poses[-2]) @ poses[-1])
        nees.append(d @ np.linalg.solve(covariance, d) / 6.0)
    # 95 % bounds of the mean of 60 runs are 0.85 and 1.16; the model is linear to first order only.
    assert 0.75 < np.mean(nees) < 1.3


def test_where_nothing_was_measured_the_prediction_stays() -> None:
    rng = np.random.default_rng(3)
    filtered = MotionFilter(CONFIG)
    for T in drive(rng, 4)[1:]:
        filtered.predict(DT)
        before, predicted = filtered.T, np.sqrt(filtered.covariance[0, 0])
        far, covariance = measured(T, rng, 3.0)
        far[0, 3] = before[0, 3] + 1.0
        filtered.fuse(far, covariance)
        assert abs(filtered.T[0, 3] - before[0, 3]) < 0.2 * predicted
        assert np.sqrt(filtered.covariance[0, 0]) == pytest.approx(predicted, rel=0.01)
        assert np.sqrt(filtered.covariance[1, 1]) <= SIGMA[1]


def test_the_motion_after_a_blind_stretch_counts_the_error_before_it() -> None:
    """Each motion's error is that of both its poses: the filter corrects the pose before as well."""
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, filtered = drive(rng, 6), MotionFilter(CONFIG)
        for k, pose in enumerate(poses[1:]):
            filtered.predict(DT)
            filtered.fuse(*measured(pose, rng, 1.0 if k < 5 else 0.0))
        T, covariance = filtered.motion()
        d = boxminus(T, invert_transform(poses[-2]) @ poses[-1])
        nees.append(d @ np.linalg.solve(covariance, d) / 6.0)
    assert 0.75 < np.mean(nees) < 1.3


def test_an_uncertain_angle_makes_all_of_a_motion_uncertain() -> None:
    """A turn by tenths of a radian about an unseen axis moves what is known to a millimetre."""
    filtered, sigma = MotionFilter(CONFIG), np.array([0.3, 0.001, 0.001, 0.001, 0.001, 0.3])
    filtered.move(np.eye(4), np.diag(sigma**2), DT)
    covariance = filtered.motion()[1]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[[0, 5]], 0.3, rtol=0.1)
    assert (np.sqrt(np.diag(covariance))[1:5] > 0.5 * 0.3 * 0.3).all()


def test_moves_by_a_known_motion() -> None:
    filtered = MotionFilter(CONFIG)
    filtered.start(make_transform(rotation_from_euler(np.pi / 2), np.array([1.0, 2.0, 0.0])))
    step = make_transform(rotation_from_euler(0.1), np.array([0.5, 0.0, 0.0]))
    covariance = np.diag([0.01, 0.04, 0.09, 1e-9, 1e-9, 4e-9])
    filtered.move(step, covariance, DT)
    np.testing.assert_allclose(filtered.T[:3, 3], [1.0, 2.5, 0.0], atol=1e-12)
    T, motion_covariance = filtered.motion()
    np.testing.assert_allclose(T, step, atol=1e-12)
    np.testing.assert_allclose(motion_covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(np.diag(filtered.covariance)[:3], [0.04, 0.01, 0.09], atol=1e-9)


def test_predicts_the_velocity_along_the_axes_of_the_sensor() -> None:
    filtered, step = MotionFilter(CONFIG), boxplus(np.eye(4), np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.2]))
    filtered.predict(DT)
    filtered.fuse(step, 1e-16 * np.eye(6))
    filtered.predict(2.0 * DT)
    np.testing.assert_allclose(
        filtered.T, step @ boxplus(np.eye(4), np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.4])), atol=1e-9
    )
    filtered.forget_velocity()
    before = filtered.T
    filtered.predict(DT)
    np.testing.assert_array_equal(filtered.T, before)


def test_a_lost_filter_takes_the_next_pose() -> None:
    filtered, T = MotionFilter(CONFIG), make_transform(rotation_from_euler(1.0), np.array([5.0, 0.0, 0.0]))
    filtered.predict(DT)
    filtered.lose()
    filtered.fuse(T, np.diag(SIGMA**2))
    np.testing.assert_allclose(filtered.T, T, atol=1e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(filtered.covariance)), SIGMA, rtol=1e-3)


def test_covariances_turn_with_the_frame() -> None:
    T = make_transform(rotation_from_euler(np.pi / 2), np.array([3.0, 0.0, 0.0]))
    np.testing.assert_allclose(np.diag(rotated(T, np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))), [2, 1, 3, 5, 4, 6])


def test_process_noise_is_filterpys():
    """Of one axis: position and velocity driven by a white acceleration that is constant within a step."""
    from filterpy.common import Q_discrete_white_noise

    config = MotionFilterConfig(acceleration_sigma=1.7, speed_sigma=0.001)
    motion = MotionFilter(config)
    before = motion._P.copy()
    motion.predict(0.13)
    F = np.array([[1.0, 0.13], [0.0, 1.0]])
    axis = np.ix_([6, 12], [6, 12])
    Q = Q_discrete_white_noise(2, 0.13, 1.7**2)
    np.testing.assert_allclose(motion._P[axis], F @ before[axis] @ F.T + Q, rtol=1e-9, atol=1e-15)
