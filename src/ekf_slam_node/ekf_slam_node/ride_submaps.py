# SPDX-License-Identifier: Apache-2.0
"""Submaps around a lift ride: one ends where it begins, the cabin has one, and the next begins at the new storey.

The cabin's landmarks stay where they were seen when the ride began, and the rig leaves them upwards: the submap of the
cabin ends at the height of the new storey, and shares no landmark with the next.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ekf_slam_node.filtering.models import Frame
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer
from ekf_slam_node.results import EkfResult
from ekf_slam_node.submaps.open_submap import LandmarkMatches
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.types import Counters, PoseEstimate, Submap


@dataclass
class RideSubmaps:
    """Ends and begins submaps as a lift takes the rig along.

    ``texts``: the rides so far in words. ``spans``: first and last stamp of each, ns.
    """

    chain: SubmapChain
    aids: RelativePoseBuffer
    counters: Counters
    texts: list[str] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)

    @property
    def finding(self) -> str:
        """The rides so far in words, or ""."""
        return f"lift rides: {', '.join(self.texts)}" if self.texts else ""

    def after_frame(self, frame: Frame, result: EkfResult) -> EkfResult:
        """Result of a frame, with its pose at the height of the cabin and the submaps that a ride has finished."""
        rides, submaps = self.aids.rides, result.submaps
        if rides.begun:
            submaps += self._begin(frame)
        if rides.ended is not None:
            submaps += self._end(frame)
            result = replace(result, pose=self.chain.result(frame.stamp_ns, result.state, result.reason).pose)
        elif rides.height is not None:
            result = replace(result, pose=self._raised(result.pose))
        return result if submaps is result.submaps else replace(result, submaps=submaps)

    def end_early(self) -> None:
        """Let the open submap end at the height of a cabin that still rides."""
        height = self.aids.rides.height
        if height is not None and self.chain.is_open and not self.chain.is_empty:
            self.chain.displace(height.height, height.variance, self._up)
        self.chain.is_held_open = False

    def _begin(self, frame: Frame) -> tuple[Submap, ...]:
        self.counters.add("lift_rides")
        self.chain.is_held_open = True
        if self.chain.is_empty:
            return ()
        self.chain.raise_path(self.aids.rides.begun, self._up)
        return self._renew(frame)

    def _end(self, frame: Frame) -> tuple[Submap, ...]:
        ride = self.aids.rides.ended
        assert ride is not None
        self.chain.is_held_open = False
        self.spans.append((ride.start_ns, ride.end_ns))
        self.texts.append(f"{ride.text} in {1e-9 * (ride.end_ns - ride.start_ns):.1f} s")
        if refused := self.aids.rides.pressure_refused:
            self.counters.add("pressure_contradicted", refused)
            self.aids.rides.pressure_refused = 0
        self.chain.raise_path(ride.heights, self._up)
        self.chain.displace(ride.height, ride.variance, self._up)
        return self._renew(frame)

    def _renew(self, frame: Frame) -> tuple[Submap, ...]:
        """Close the open submap and begin the next at its end, without a common landmark."""
        submaps = self.chain.close()
        self.chain.follow(frame, LandmarkMatches.of_nothing(), LandmarkMatches.of_nothing(), self.aids.up)
        return submaps

    def _raised(self, pose: PoseEstimate) -> PoseEstimate:
        height = self.aids.rides.height
        assert height is not None
        return self._up.seen_from(pose.T).raised(pose, height.height, height.variance)

    @property
    def _up(self) -> UpDirection:
        inertial = self.aids.inertial
        return UpDirection(inertial.up, inertial.tilt_covariance)
