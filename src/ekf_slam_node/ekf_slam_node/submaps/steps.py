# SPDX-License-Identifier: Apache-2.0
"""Records that the steps of Algorithm 3 hand on within one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.association.linking import FrameLink
from ekf_slam_node.filtering.candidates import MotionPrior
from ekf_slam_node.filtering.ekf import UpdateReport
from ekf_slam_node.filtering.models import Frame
from ekf_slam_node.odometry.relative_poses import RelativePoseMeasurement
from ekf_slam_node.results import TrackingState
from ekf_slam_node.submaps.open_submap import LandmarkMatches
from slam_core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class Associated:
    """Pairs of a frame, and its motion as it was expected and as other sensors have told it, too (``prior``)."""

    link: FrameLink
    expected: MotionPrior
    prior: MotionPrior


@dataclass(frozen=True, eq=False)
class LinkedFrame:
    """A frame that is associated with the map, its features moved to one instant; ``measured``: as they were seen.

    dt: since the previous linked frame, s. aid: motion from other sensors, if any. common: (6,) standard deviations of
    the pose error that all its features share. surprising: its motion contradicts constant velocity. landmarks: how
    many there were to link to; rows of the link beyond them are features of the previous frame.
    """

    frame: Frame
    measured: Frame
    dt: float
    link: FrameLink
    aid: RelativePoseMeasurement | None
    common: FloatArray
    surprising: bool
    landmarks: int

    @property
    def motion_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the motion that the pairs show, with the error that they share."""
        return np.asarray(self.link.covariance + np.diag(self.common**2))


@dataclass(frozen=True, eq=False)
class UpdatedFrame:
    """Outcome of a measurement update.

    Landmarks ``measured``, whether the submap ``closes`` with this frame, and who was measured: ids (k,) of the
    landmarks, index (k,) of the features.
    """

    report: UpdateReport
    measured: LandmarkMatches
    closes: bool
    ids: np.ndarray
    index: np.ndarray

    def state(self, link: FrameLink) -> tuple[TrackingState, str]:
        """State of the filter after the frame, and its reason."""
        if not self.report.applied:
            return TrackingState.DEGRADED, "no landmark could be measured, moved by the prediction alone"
        return sureness(link)


def sureness(link: FrameLink) -> tuple[TrackingState, str]:
    """State of the filter after a frame with such a link, and its reason."""
    if link.is_sure:
        return TrackingState.OK, ""
    counts = f"{link.moving} features move against the {len(link.rows)} that the pose rests on"
    return TrackingState.DEGRADED, f"moving objects: {counts}, and nothing else tells which are the room"
