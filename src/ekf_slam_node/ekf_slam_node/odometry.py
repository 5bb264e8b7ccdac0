# SPDX-License-Identifier: Apache-2.0
"""The chain of submaps in the odom frame, smooth from frame to frame."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray, compose_covariance, transform_points
from slam_core.types import PoseEstimate

_ORIGIN_SIGMA = 1e-6
"""Standard deviation of the first pose (m, rad): it is the origin by definition, but no covariance may be singular."""


class OdometryChain:
    """``T_odom_submap`` of the open submap with its covariance.

    Successive submaps count as independent. The noise of the frame they share enters both with opposite signs, so that
    the covariance of the chain is a little too large, never too small.
    """

    def __init__(self) -> None:
        self._T = np.eye(4)
        self._covariance = _ORIGIN_SIGMA**2 * np.eye(6)

    def pose(self, stamp_ns: int, T: FloatArray, covariance: FloatArray) -> PoseEstimate:
        """T_odom_rig of a pose in the open submap."""
        return PoseEstimate(stamp_ns, self._T @ T, compose_covariance(self._T, self._covariance, T, covariance))

    def advance(self, end: PoseEstimate) -> None:
        """The open submap is finished, the next one starts at this pose T_odom_rig."""
        self._T, self._covariance = end.T, end.covariance

    def points(self, points: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (n, 3) of the open submap in the odom frame, with covariances (n, 3, 3).

        The covariances are relative to the submap's start.
        """
        R = self._T[:3, :3]
        return transform_points(self._T, points), R @ covariances @ R.T
