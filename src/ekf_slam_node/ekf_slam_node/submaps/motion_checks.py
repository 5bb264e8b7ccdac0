# SPDX-License-Identifier: Apache-2.0
"""Checks of a frame's motion: against the prediction, other sensors, and no motion at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ekf_slam_node.association.linking import FrameLink
from ekf_slam_node.filtering.candidates import MotionPrior
from ekf_slam_node.filtering.models import relative_motion
from ekf_slam_node.odometry.relative_poses import ALL, RelativePoseMeasurement
from ekf_slam_node.submaps.steps import LinkedFrame
from slam_core.geometry import FloatArray, boxminus

_BRIDGE_SIGMA = 0.3
"""Frames without association are bridged while the position is known this well, m, ..."""
_BRIDGE_SHARE = 0.1
"""... or to this share of the way that an odometry has counted."""
_LONGEST_BRIDGE_NS = 600_000_000_000
"""The poses of an odometry's bridge are kept until images see again, at most for so long."""
_STANDING_SIGMA = np.repeat([0.002, np.radians(0.05)], 3)
"""Motions (m, rad) must be known as well as this for a rig to be seen standing."""


def is_surprising(link: FrameLink, expected: MotionPrior, gate: float) -> bool:
    """True if the motion found contradicts constant velocity, by the gate of one feature.

    What a motion within this gate moves a feature by lies within the same gate of that feature: the normalised length
    of an error cannot grow when it is seen in three coordinates. With a wider gate here than there a motion would pass
    whose features are all refused.
    """
    error = boxminus(link.T, expected.T)
    return float(error @ np.linalg.solve(expected.covariance + link.covariance, error)) > gate


def is_still(linked: LinkedFrame, gate: float) -> bool:
    """True if the motion found is none, as far as a good look can tell."""
    # The landmarks' errors are correlated, so that a motion from them is known a little less well than it says.
    covariance = linked.motion_covariance + np.diag((0.25 * _STANDING_SIGMA) ** 2)
    error = boxminus(linked.link.T, np.eye(4))
    known = bool((np.sqrt(np.diag(linked.link.covariance)) < _STANDING_SIGMA).all())
    return known and float(error @ np.linalg.solve(covariance, error)) < gate


class StandingDetector:
    """Counts frames without motion; after ``frames`` of them the rig stands (0: never)."""

    def __init__(self, frames: int, gate: float) -> None:
        self._frames = frames
        self._gate = gate
        self._still = 0

    def add(self, linked: LinkedFrame) -> bool:
        """Take a frame; returns True if the rig has not moved for some frames, this one included."""
        self._still = self._still + 1 if is_still(linked, self._gate) else 0
        return 0 < self._frames < self._still


def inflated_process_noise(
    T_previous_now: FloatArray, velocity: FloatArray, sigma: FloatArray, dt: float
) -> FloatArray:
    """Acceleration noise (6,) with which the model can explain a motion: sigma (6,), larger where it must be."""
    needed = 2.0 * boxminus(T_previous_now, relative_motion(velocity, dt)) / dt**2
    sizes = np.repeat(np.linalg.norm(needed.reshape(2, 3), axis=1), 3)
    return np.asarray(np.maximum(sigma, sizes))


def fused_prior(expected: MotionPrior, aid: RelativePoseMeasurement | None) -> MotionPrior:
    """Motion prior of the next frame where another sensor has measured the motion, or its rotation."""
    if aid is None:
        return expected
    T, covariance = expected.T.copy(), expected.covariance.copy()
    if aid.rows == ALL:
        return MotionPrior(aid.T, aid.covariance)
    T[:3, :3] = aid.T[:3, :3]
    covariance[3:, :] = covariance[:, 3:] = 0.0
    covariance[3:, 3:] = aid.covariance
    return MotionPrior(T, covariance)


def widened(aid: RelativePoseMeasurement, common: FloatArray) -> RelativePoseMeasurement:
    """A motion from scans as seen by the picture: at both ends the two differ by the pose error (6,) of a frame."""
    if aid.rows != ALL:
        return aid
    return replace(aid, covariance=aid.covariance + 2.0 * np.diag(common**2))


def is_known(aid: RelativePoseMeasurement) -> bool:
    """True if the place that a motion leads to is known well enough to go on from it."""
    limit = _BRIDGE_SIGMA
    if (reckoned := aid.reckoned) is not None:
        if reckoned.stamp_ns - reckoned.start_ns > _LONGEST_BRIDGE_NS:
            return False
        limit = max(limit, _BRIDGE_SHARE * reckoned.travelled)
    return float(np.trace(aid.covariance[:3, :3])) < limit**2
