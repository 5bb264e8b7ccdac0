# SPDX-License-Identifier: Apache-2.0
"""Pose and velocity of a sensor by white acceleration (thesis Eq. 5.6), with the pose before kept beside them.

Each registration is joined with what the motion so far lets expect, each by its covariance: along a corridor, where a
registration says nothing, the prediction and its own doubt of a few centimetres remain instead of metres. The pose
before stays in the state and is corrected with it, so that the motion between two scans comes with the covariance of
both together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import (
    FloatArray,
    both_halves,
    boxminus,
    boxplus,
    compose_jacobians,
    inverse_jacobian,
    invert_transform,
    make_transform,
    pose7_from_transform,
    transform_from_pose7,
)
from slam_core.types import ORIGIN_SIGMA

BEFORE, NOW, VELOCITY = slice(0, 6), slice(6, 12), slice(12, 18)
_LOST_SIGMA = 100.0
"""Standard deviation (m, rad) of a pose of which nothing is known."""


@dataclass(frozen=True)
class MotionFilterConfig(Config):
    """Motion model of a sensor between scans."""

    acceleration_sigma: float = parameter(2.0, "acceleration between scans", unit="m/s2", minimum=1e-3)
    angular_acceleration_sigma: float = parameter(4.0, "likewise", unit="rad/s2", minimum=1e-3)
    speed_sigma: float = parameter(1.0, "speed where nothing is known of it", unit="m/s", minimum=1e-3)
    angular_speed_sigma: float = parameter(1.0, "likewise", unit="rad/s", minimum=1e-3)


class MotionFilter:
    """Kalman filter of the errors of (pose before, pose, velocity).

    Poses along the axes of the odometry's frame, the velocity along the sensor's, in which one who walks and turns
    moves steadily.
    """

    def __init__(self, config: MotionFilterConfig) -> None:
        self._acceleration = np.repeat([config.acceleration_sigma, config.angular_acceleration_sigma], 3)
        self._speed = np.repeat([config.speed_sigma, config.angular_speed_sigma], 3)
        self.start(np.eye(4))

    def start(self, T: FloatArray) -> None:
        """Be at ``T`` (4, 4), with a velocity of which nothing is known."""
        self.T_before, self.T = T, T
        self._velocity = np.zeros(6)
        self._dt = 0.0
        self._P = np.diag(np.r_[np.full(12, ORIGIN_SIGMA), self._speed] ** 2)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (6, 6) of the error of ``T``."""
        return self._P[NOW, NOW].copy()

    def forget_velocity(self) -> None:
        """Know nothing of the velocity any more, as after a gap between scans."""
        self._velocity = np.zeros(6)
        self._P[VELOCITY], self._P[:, VELOCITY] = 0.0, 0.0
        self._P[VELOCITY, VELOCITY] = np.diag(self._speed**2)

    def lose(self) -> None:
        """Know nothing of pose and velocity any more: the next observed pose is taken as it is."""
        self.forget_velocity()
        self._P[NOW], self._P[:, NOW] = 0.0, 0.0
        self._P[NOW, NOW] = _LOST_SIGMA**2 * np.eye(6)

    def predict(self, dt: float) -> None:
        """Move on by ``dt`` s (Eq. 5.6); the pose so far becomes the pose before."""
        R = both_halves(self.T[:3, :3])
        F = np.zeros((18, 18))
        F[BEFORE, NOW] = F[NOW, NOW] = F[VELOCITY, VELOCITY] = np.eye(6)
        F[NOW, VELOCITY] = dt * R
        G = np.zeros((18, 6))
        G[NOW], G[VELOCITY] = R @ np.diag(0.5 * dt**2 * self._acceleration), np.diag(dt * self._acceleration)
        self._P = F @ self._P @ F.T + G @ G.T
        self.T_before, self.T = self.T, self.T @ boxplus(np.eye(4), dt * self._velocity)
        self._dt = dt

    def move(self, T: FloatArray, covariance: FloatArray, dt: float) -> None:
        """Move on by a known motion (4, 4), in the axes of the pose so far, with covariance (6, 6), in ``dt`` s."""
        self.forget_velocity()
        self._P[BEFORE, BEFORE] = self._P[BEFORE, NOW] = self._P[NOW, BEFORE] = self._P[NOW, NOW]
        self._P[NOW, NOW] = self._P[BEFORE, BEFORE] + rotated(self.T, covariance)
        self.T_before, self.T = self.T, self.T @ T
        self._dt = dt

    def turn(self, R: FloatArray, sigma: float) -> None:
        """Replace the predicted turn by a known one (3, 3), in the axes of the pose before, ``sigma`` rad per axis."""
        before, now = slice(3, 6), slice(9, 12)
        self._P[now], self._P[:, now] = self._P[before], self._P[:, before]
        self._P[now, now] = self._P[before, before] + sigma**2 * np.eye(3)
        self.T = make_transform(self.T_before[:3, :3] @ R, self.T[:3, 3])

    def correction(self, T: FloatArray, covariance: FloatArray) -> FloatArray:
        """Correction (6,) of this pose by a measured one (4, 4), each weighted by its covariance."""
        predicted = self.covariance
        return np.asarray(predicted @ np.linalg.solve(predicted + covariance, boxminus(T, self.T)))

    def fuse(self, T: FloatArray, covariance: FloatArray) -> None:
        """Fuse a measured pose (4, 4) with covariance (6, 6); where that is large, the prediction stays."""
        step = self._update(covariance) @ boxminus(T, self.T)
        self.T_before, self.T = _moved(self.T_before, step[BEFORE]), _moved(self.T, step[NOW])
        self._velocity = boxminus(invert_transform(self.T_before) @ self.T, np.eye(4)) / self._dt

    def motion(self) -> tuple[FloatArray, FloatArray]:
        """Motion (4, 4) from the pose before to this one, in the axes of the former, and its covariance (6, 6)."""
        inverse = invert_transform(self.T_before)
        J_inverse, J_now = compose_jacobians(inverse, self.T)
        J = np.hstack([J_inverse @ inverse_jacobian(self.T_before), J_now])
        covariance = J @ self._P[:12, :12] @ J.T
        return inverse @ self.T, _with_second_order(0.5 * (covariance + covariance.T))

    def _update(self, R: FloatArray) -> FloatArray:
        """Gain (18, 6) of a measured pose with covariance R (6, 6).

        The covariance in Joseph's form, which stays positive definite whatever the range of R's eigenvalues.
        """
        H = np.zeros((6, 18))
        H[:, NOW] = np.eye(6)
        K = np.linalg.solve(self._P[NOW, NOW] + R, self._P[NOW]).T
        A = np.eye(18) - K @ H
        P = A @ self._P @ A.T + K @ R @ K.T
        self._P = 0.5 * (P + P.T)
        return np.asarray(K)


def _with_second_order(covariance: FloatArray) -> FloatArray:
    """A covariance (6, 6) with what it leaves out, half the product of an error of angle with the whole error.

    Before a blank wall an angle errs by degrees, and a plane known to a millimetre is turned with it. A product of two
    Gaussian errors has at most three times the product of their variances.
    """
    shift, turn = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    return np.asarray(covariance + 0.75 * turn * np.diag(np.repeat([shift, turn], 3)))


def _moved(T: FloatArray, step: FloatArray) -> FloatArray:
    """``boxplus``, made exactly orthonormal: rounding in a chain of rotations doubles with every transposition."""
    return transform_from_pose7(pose7_from_transform(boxplus(T, step)))


def rotated(T: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of an error along the axes of ``T``'s child frame, along those of its parent."""
    R = both_halves(T[:3, :3])
    return np.asarray(R @ covariance @ R.T)
