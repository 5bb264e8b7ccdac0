# SPDX-License-Identifier: Apache-2.0
"""Frames without a link to the map: dead reckoning, bridging by odometry or IMU, or else a new submap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer, RelativePoseMeasurement
from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.submaps.missed_frames import MissedFrames
from ekf_slam_node.submaps.motion_checks import is_known
from ekf_slam_node.submaps.open_submap import LandmarkMatches
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.types import Counters, PoseEstimate


@dataclass
class LossRecovery:
    """Moves the filter of :class:`~ekf_slam_node.slam.EkfSlam` where no association does.

    ``advance`` processes a frame that can be linked again.
    """

    config: EkfSlamConfig
    chain: SubmapChain
    aids: RelativePoseBuffer
    missed: MissedFrames
    counters: Counters
    advance: Callable[[Frame], EkfResult]

    def count_aid(self, applied: bool) -> None:
        """Count a motion that something else has measured."""
        self.counters.add("aids_used" if applied else "aids_rejected")

    def arrive(self, frame: Frame, standing: bool = False) -> None:
        """The filter has reached a frame: its pose joins the submap's path."""
        self.chain.add_pose(frame.stamp_ns, standing)
        self._drop_older(frame)

    def dead_reckon(self, frame: Frame, dt: float, aid: RelativePoseMeasurement) -> EkfResult:
        """No link, but something else has measured the motion: go with it."""
        self._go_with(frame, dt, aid)
        reason = "no visual association, moved by odometry alone"
        return self.chain.result(frame.stamp_ns, TrackingState.DEGRADED, reason)

    def track_lost(self, frame: Frame, bridge: RelativePoseMeasurement | None) -> EkfResult:
        """No link: nothing is mapped.

        The filter stays at the last linked frame, so that the old map can be found again. Odometry or IMU tell
        meanwhile where the rig is, as long as they know. Two missed frames that link to each other begin a new submap.
        """
        is_bridged = bridge is not None and is_known(bridge)
        missed = self.missed.add(frame)
        if missed is not None:
            return self._restart_after_gap(missed, frame) if is_bridged else self._restart(missed, frame)
        if bridge is not None and is_bridged:
            self.counters.add("frames_bridged")
            reason = f"no visual association, bridged by {bridge.source}"
            bridged = self.chain.add_bridged_pose(frame.stamp_ns, bridge)
            return self.chain.result(frame.stamp_ns, TrackingState.DEGRADED, reason, pose=bridged)
        self.counters.add("frames_lost")
        reason = f"{len(frame)} features, fewer than {self.config.association.min_inliers} associations"
        return self.chain.result(frame.stamp_ns, TrackingState.LOST, reason)

    def abandon(self, frame: Frame, reason: str, result: EkfResult | None = None) -> EkfResult:
        """Give up the open submap, which cannot be trusted any more, and begin a new one at this frame."""
        self.counters.add("submaps_abandoned")
        self._start(frame, self.chain.last_sound_pose(frame.stamp_ns))
        reason = f"{reason}: the open submap is given up, a new one begins"
        return self.chain.result(frame.stamp_ns, TrackingState.LOST, reason, () if result is None else result.submaps)

    def begin(self, frame: Frame) -> EkfResult:
        """Begin a map at a frame."""
        self._start(frame)
        if len(frame) < self.config.association.min_inliers:
            reason = f"only {len(frame)} features to begin with"
            return self.chain.result(frame.stamp_ns, TrackingState.DEGRADED, reason)
        return self.chain.result(frame.stamp_ns, TrackingState.OK, "")

    def end_where_odometry_is(self) -> None:
        """Let the open submap end where an odometry has carried the rig to, if the last frames had no link."""
        last = self.missed.last
        if last is None or not (self.chain.is_open and self.chain.is_bridging):
            return
        bridge = self.aids.bridge(self.chain.stamp_ns, last.stamp_ns)
        if bridge is not None and bridge.reckoned is not None and is_known(bridge):
            self._go_with(last, seconds_between(self.chain.stamp_ns, last.stamp_ns), bridge)

    def _go_with(self, frame: Frame, dt: float, aid: RelativePoseMeasurement) -> None:
        """Move the filter to a frame that is not linked by a motion that something else has measured."""
        self.count_aid(self.chain.local.move_without_link(frame, dt, aid))
        self.aids.moved(self.chain.stamp_ns, frame.stamp_ns)
        self.arrive(frame)

    def _restart_after_gap(self, missed: Frame, frame: Frame) -> EkfResult:
        """Begin a new submap at a missed frame, to which odometry or IMU have carried the rig: the old one ends there.

        The old landmarks are no longer known well from there, and all wrong by the same: a gate that holds this error
        lets a few features of other places through, and these would decide where the rig is.
        """
        start_ns = self.chain.stamp_ns
        bridge = self.aids.bridge(start_ns, missed.stamp_ns)
        if bridge is None:
            return self._restart(missed, frame)
        self.counters.add("gaps_bridged")
        self._go_with(missed, seconds_between(start_ns, missed.stamp_ns), bridge)
        submaps = self.chain.close()
        self.chain.follow(missed, LandmarkMatches.of_nothing(), LandmarkMatches.of_nothing(), self.aids.up)
        self.chain.local.set_velocity(*self.aids.velocity())
        result = self.advance(frame)
        return replace(result, submaps=submaps + result.submaps)

    def _restart(self, missed: Frame, frame: Frame) -> EkfResult:
        """The old map is not found again, but two missed frames agree: a new submap begins at the first of them."""
        submaps = self.chain.close()
        self._start(missed, self.chain.pose(missed.stamp_ns))
        result = self.advance(frame)
        return replace(result, submaps=submaps + result.submaps)

    def _start(self, frame: Frame, pose: PoseEstimate | None = None) -> None:
        self.aids.moved(self.chain.stamp_ns, frame.stamp_ns)
        self.chain.start(frame, pose, self.aids.up)
        self._drop_older(frame)

    def _drop_older(self, frame: Frame) -> None:
        """Forget missed frames and readings of other sensors from before a frame that is in the map."""
        self.missed.clear()
        self.aids.forget_before(frame.stamp_ns)
