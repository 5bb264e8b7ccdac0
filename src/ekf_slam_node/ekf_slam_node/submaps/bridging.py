# SPDX-License-Identifier: Apache-2.0
"""Poses that no image confirms, corrected once an image does: a smoother over the time that was bridged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.odometry.relative_poses import RelativePoseMeasurement
from slam_core.geometry import FloatArray, both_halves, boxminus, boxplus, compose_covariance, compose_jacobians
from slam_core.linear_algebra import blas
from slam_core.types import PoseEstimate

_LEAST_EIGENVALUE = 1e-12
"""Share of the largest eigenvalue that rounding may reach."""


@dataclass(frozen=True, eq=False)
class BridgedPose:
    """A pose that ``motion`` leads to from the last pose that images have confirmed."""

    before: PoseEstimate
    motion: RelativePoseMeasurement
    stamp_ns: int

    @property
    def pose(self) -> PoseEstimate:
        """The pose as it was predicted."""
        before, motion = self.before, self.motion
        covariance = compose_covariance(before.T, before.covariance, motion.T, motion.covariance)
        return PoseEstimate(self.stamp_ns, before.T @ motion.T, covariance)

    def covariance_with(self, later: BridgedPose) -> FloatArray | None:
        """Covariance (6, 6) of this pose's error with that of a later one; None where the motions do not tell."""
        between = None if later.motion.reckoned is None else later.motion.reckoned.covariance_with(self.motion.reckoned)
        if between is None:
            return None
        turn = both_halves(self.before.T[:3, :3])
        J_own, J_later = (compose_jacobians(self.before.T, b.motion.T)[0] for b in (self, later))
        return np.asarray(J_own @ self.before.covariance @ J_later.T + turn @ between @ turn.T)


def smoothed(bridged: list[BridgedPose], end: PoseEstimate) -> list[PoseEstimate]:
    """The poses that were ``bridged`` but for the last, corrected by what is known of it in the end.

    By the covariance of each pose with the last where that is known (Rauch-Tung-Striebel). The error of a way found by
    accelerations grows with the square of time at most, that of the turn with time.
    """
    last, start_ns = bridged[-1].pose, bridged[0].before.stamp_ns
    error, excess = boxminus(end.T, last.T), last.covariance - end.covariance
    corrected = []
    for one in bridged[:-1]:
        pose, together = one.pose, one.covariance_with(bridged[-1])
        if together is None:
            share = (pose.stamp_ns - start_ns) / (end.stamp_ns - start_ns)
            gain = np.diag(np.repeat([share**2, share], 3))
        else:
            gain = np.linalg.solve(last.covariance, together.T).T
        covariance = positive_definite(pose.covariance - gain @ excess @ gain.T)
        corrected.append(PoseEstimate(pose.stamp_ns, boxplus(pose.T, gain @ error), covariance))
    return corrected


def positive_definite(P: FloatArray) -> FloatArray:
    """A covariance whose smallest eigenvalues rounding has made negative, with these raised; others as they are."""
    if blas.cholesky(np.array(P.T, order="F")):
        return P
    values, vectors = np.linalg.eigh(P)
    return np.asarray((vectors * np.maximum(values, _LEAST_EIGENVALUE * values[-1])) @ vectors.T)
