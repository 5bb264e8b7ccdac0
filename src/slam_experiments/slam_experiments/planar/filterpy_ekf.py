# SPDX-License-Identifier: Apache-2.0
"""The planar filter with filterpy's extended Kalman filter in place of our own: a second implementation to check by.

Models, association and new landmarks are :mod:`slam_experiments.planar.ekf`'s; the time and the measurement update of
mean and covariance are filterpy's, dense, in the standard error state.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from ekf_slam_node.association.jcbb import IndexArray
from ekf_slam_node.filtering.covariance import Covariance
from ekf_slam_node.filtering.ekf import UpdateReport
from slam_core.geometry import FloatArray
from slam_experiments.planar.ekf import POSE_DIM, PlanarConfig, PlanarEkf, move, range_bearing, wrap


class FilterpyPlanarEkf(PlanarEkf):
    """As :class:`PlanarEkf` with ``error: standard``; a step costs the cube of the landmarks, not their square."""

    def __init__(self, config: PlanarConfig, pose: FloatArray, pose_covariance: FloatArray) -> None:
        super().__init__(replace(config, error="standard"), pose, pose_covariance)

    def predict(self, motion: FloatArray, motion_covariance: FloatArray) -> None:
        """Move by (3,) in the robot's frame, with covariance (3, 3)."""
        theirs = self._theirs(measured=1)
        after, theirs.F[:POSE_DIM, :POSE_DIM], G = move(self.pose, motion)
        theirs.Q[:POSE_DIM, :POSE_DIM] = G @ motion_covariance @ G.T
        theirs.predict()
        theirs.x[:POSE_DIM] = after  # not F x
        self._take(theirs)

    def update(self, measured: FloatArray, slots: IndexArray) -> UpdateReport:
        """Measurements (k, 2) of the landmarks ``slots`` (k,)."""
        z, J_pose, J_landmark = range_bearing(self.pose, self.landmarks[slots])
        k = len(slots)
        theirs = self._theirs(measured=2 * k)
        H = np.zeros((k, 2, len(theirs.x)))
        H[:, :, :POSE_DIM] = J_pose
        for row, slot in enumerate(slots):
            H[row, :, POSE_DIM + 2 * slot : POSE_DIM + 2 * slot + 2] = J_landmark[row]
        theirs.update(
            measured.ravel(), lambda _: H.reshape(2 * k, -1), lambda _: z.ravel(), np.kron(np.eye(k), self._noise),
            residual=_difference,
        )  # fmt: skip
        self._take(theirs)
        return UpdateReport(float(theirs.y @ theirs.SI @ theirs.y), 2 * k, True)

    def _theirs(self, measured: int) -> ExtendedKalmanFilter:
        """A filter of filterpy at the present mean and covariance, for a number of measured values."""
        theirs = ExtendedKalmanFilter(self.covariance.size, measured)
        theirs.x = np.concatenate([self.pose, self.landmarks.ravel()])
        theirs.P, theirs.Q = self.covariance.dense(), np.zeros((self.covariance.size,) * 2)
        return theirs

    def _take(self, theirs: ExtendedKalmanFilter) -> None:
        """Mean and covariance of a filter of filterpy."""
        self.pose = np.array([*theirs.x[:2], wrap(theirs.x[2])])
        self.landmarks = theirs.x[POSE_DIM:].reshape(-1, 2)
        self.covariance = Covariance(theirs.P)


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Difference of ranges and bearings (2 k,) in turn."""
    found = a - b
    found[1::2] = wrap(found[1::2])
    return found
