# SPDX-License-Identifier: Apache-2.0
"""The chain of submaps in the odom frame, smooth from frame to frame, its roll and pitch held by gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import (
    FloatArray,
    boxplus,
    compose_covariance,
    compose_jacobians,
    invert_transform,
    skew,
    transform_points,
)
from slam_core.types import ORIGIN_SIGMA, PoseEstimate

_LEAST_SIGMA = np.radians(0.5)
"""Gravity counts from when it is known to this angle."""
_SAME_ERROR_S = 20.0
"""Errors of gravity come from biases, which stay for so long: what is measured more often counts for less."""


@dataclass(frozen=True, eq=False)
class UpDirection:
    """Unit vector (3,) upwards along the rig's axes, with its covariance (3, 3), singular along it."""

    direction: FloatArray
    covariance: FloatArray

    def seen_from(self, T: FloatArray) -> UpDirection:
        """The direction along the axes of another frame, ``T`` = T_frame_own (4, 4)."""
        R = T[:3, :3]
        return UpDirection(R @ self.direction, R @ self.covariance @ R.T)

    def raised(self, pose: PoseEstimate, height: float, variance: float) -> PoseEstimate:
        """A pose in the direction's frame, raised by a height (m) with its variance."""
        T, covariance = pose.T.copy(), pose.covariance.copy()
        T[:3, 3] += height * self.direction
        covariance[:3, :3] += self.spread(height, variance)
        return PoseEstimate(pose.stamp_ns, T, covariance)

    def spread(self, height: float, variance: float) -> FloatArray:
        """Covariance (3, 3) of a way upwards by a height (m) with its variance."""
        return np.asarray(variance * np.outer(self.direction, self.direction) + height**2 * self.covariance)


class OdometryChain:
    """``T_odom_submap`` of the open submap with its covariance.

    Successive submaps count as independent. The noise of the frame they share enters both with opposite signs, so that
    the covariance of the chain is a little too large, never too small.

    The odom frame is that of the first pose, whatever its attitude. Which way is up in it becomes known by the first
    look at gravity, better by further ones, and from then on tells how far roll and pitch have drifted: a Kalman filter
    of pose and up direction. The position stays where it is, because odometry must not jump.
    """

    def __init__(self) -> None:
        self._T = np.eye(4)
        self._up: FloatArray | None = None
        self._levelled_ns = 0
        # Of the errors of pose (6) and up direction (3).
        self._covariance = np.zeros((9, 9))
        self._covariance[:6, :6] = ORIGIN_SIGMA**2 * np.eye(6)

    def pose(self, stamp_ns: int, T: FloatArray, covariance: FloatArray) -> PoseEstimate:
        """T_odom_rig of a pose in the open submap."""
        return PoseEstimate(stamp_ns, self._T @ T, compose_covariance(self._T, self._covariance[:6, :6], T, covariance))

    def advance(self, end: PoseEstimate, up: UpDirection | None = None) -> None:
        """The open submap is finished, the next one starts at this pose T_odom_rig, where gravity may be known."""
        J, _ = compose_jacobians(self._T, invert_transform(self._T) @ end.T)
        cross = J @ self._covariance[:6, 6:]
        self._T = end.T
        self._covariance[:6, :6] = end.covariance
        self._covariance[:6, 6:], self._covariance[6:, :6] = cross, cross.T
        if up is not None and np.trace(up.covariance) < 2.0 * _LEAST_SIGMA**2:
            self._level(up, end.stamp_ns)

    def points(self, points: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (n, 3) of the open submap in the odom frame, with covariances (n, 3, 3).

        The covariances are relative to the submap's start.
        """
        R = self._T[:3, :3]
        return transform_points(self._T, points), R @ covariances @ R.T

    def _level(self, up: UpDirection, stamp_ns: int) -> None:
        R = self._T[:3, :3]
        measured, noise = R @ up.direction, R @ up.covariance @ R.T
        H = np.zeros((3, 9))
        H[:, 3:6] = -skew(measured)
        if self._up is None:
            self._up = measured
            self._covariance[6:, :6] = H[:, :6] @ self._covariance[:6, :6]
            self._covariance[:6, 6:] = self._covariance[6:, :6].T
            self._covariance[6:, 6:] = H[:, :6] @ self._covariance[:6, :6] @ H[:, :6].T + noise
        else:
            H[:, 6:] = -np.eye(3)
            since = max((stamp_ns - self._levelled_ns) * 1e-9, 1e-3)
            self._update(self._up - measured, H, noise * max(_SAME_ERROR_S / since, 1.0))
        self._levelled_ns = stamp_ns

    def _update(self, error: FloatArray, H: FloatArray, noise: FloatArray) -> None:
        """Update of the two directions across the vertical; along it nothing is measured."""
        assert self._up is not None
        across = np.linalg.svd(self._up[None])[2][1:]
        H = across @ H
        gain = np.linalg.solve(H @ self._covariance @ H.T + across @ noise @ across.T, H @ self._covariance).T
        gain[:3] = 0.0
        delta = gain @ (across @ error)
        self._T = boxplus(self._T, delta[:6])
        up = self._up + delta[6:]
        self._up = up / np.linalg.norm(up)
        # Joseph's form, which holds for any gain.
        A = np.eye(9) - gain @ H
        self._covariance = A @ self._covariance @ A.T + gain @ across @ noise @ across.T @ gain.T
