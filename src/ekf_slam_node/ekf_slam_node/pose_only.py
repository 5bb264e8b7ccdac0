# SPDX-License-Identifier: Apache-2.0
"""Frames that tell the pose alone: where the rig is between frames that map, while the filter stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.filtering.correlated_noise import CorrelatedNoise
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.frame_association import FrameAssociation
from ekf_slam_node.odometry.relative_poses import ALL, RelativePoseBuffer, RelativePoseMeasurement
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.ride_submaps import RideSubmaps
from ekf_slam_node.submaps.motion_checks import is_known
from ekf_slam_node.submaps.steps import Associated, sureness
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.types import Counters

_LONGEST_S = 0.5
"""Time without a frame that maps, after which one that cannot be linked counts as one: those between may be lost."""


@dataclass
class PoseOnlyFrames:
    """Locates the frames of :class:`~ekf_slam_node.slam.EkfSlam` that map nothing.

    The pose is that of the landmarks and of the last mapping frame's other features, as the filter's pose has them
    around it. ``map_frame`` processes a frame as one that maps. ``newest``: the last one since the filter moved.
    """

    chain: SubmapChain
    association: FrameAssociation
    aids: RelativePoseBuffer
    common: CorrelatedNoise
    rides: RideSubmaps
    counters: Counters
    map_frame: Callable[[Frame], EkfResult]
    newest: Frame | None = None

    def locate(self, frame: Frame) -> EkfResult:
        """Tell where the rig is at a frame; by other sensors if the images do not say."""
        aid = self.aids.between(self.chain.stamp_ns, frame.stamp_ns)
        found = self._associated(frame, aid)
        if found is not None:
            self.newest = frame
            self.counters.add("frames_pose_only")
            covariance = found.link.covariance + np.diag(self.common.sigma(frame) ** 2)
            pose = self.chain.add_located_pose(frame.stamp_ns, found.link.T, covariance)
            return self.chain.result(frame.stamp_ns, *sureness(found.link), pose=self.rides.raised(pose))
        if (before := self.advance()) is not None:
            result = self.locate(frame)
            return replace(result, submaps=before.submaps + result.submaps)
        if frame.stamp_ns - self.chain.stamp_ns > 1e9 * _LONGEST_S:
            return self.map_frame(frame)
        return self._carried(frame, aid)

    def advance(self) -> EkfResult | None:
        """Let the filter move to the last frame that was located, if there is one since it moved last."""
        frame, self.newest = self.newest, None
        return None if frame is None else self.map_frame(frame)

    def _associated(self, frame: Frame, aid: RelativePoseMeasurement | None) -> Associated | None:
        dt = seconds_between(self.chain.stamp_ns, frame.stamp_ns)
        try:
            return self.association.of(frame, dt, aid, maps=False)
        except np.linalg.LinAlgError:
            return None

    def _carried(self, frame: Frame, aid: RelativePoseMeasurement | None) -> EkfResult:
        """No link: the next frame that maps decides what becomes of the map. Other sensors may know the pose."""
        knows = aid is not None and aid.rows == ALL and aid.source == "scans"
        told = aid if knows else self.aids.bridge(self.chain.stamp_ns, frame.stamp_ns)
        if told is None or not is_known(told):
            self.counters.add("frames_lost")
            return self.chain.result(frame.stamp_ns, TrackingState.LOST, f"{len(frame)} features followed, none known")
        self.counters.add("frames_bridged")
        pose = self.chain.add_located_pose(frame.stamp_ns, told.T, told.covariance)
        reason = f"no visual association, bridged by {told.source}"
        return self.chain.result(frame.stamp_ns, TrackingState.DEGRADED, reason, pose=self.rides.raised(pose))
