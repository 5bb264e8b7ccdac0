# SPDX-License-Identifier: Apache-2.0
"""Submaps around a lift ride: one ends where it begins, the cabin has one, and the next begins at the new storey.

The cabin's landmarks stay where they were seen when the ride began, and the rig leaves them upwards: the submap of the
cabin ends at the height of the new storey, and shares no landmark with the next.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ekf_slam_node.filtering.models import Frame
from ekf_slam_node.odometry.cabin import Ride
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.relative_poses import RelativePoseBuffer
from ekf_slam_node.odometry.ride_filter import HeightAt
from ekf_slam_node.results import EkfResult
from ekf_slam_node.submaps.open_submap import LandmarkMatches
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.types import Counters, PoseEstimate, Submap


@dataclass
class RideSubmaps:
    """Ends and begins submaps as a lift takes the rig along.

    ``texts``: the rides so far in words. ``spans``: first and last stamp of each, ns. ``begun``: height at which the
    submap outside has ended, during a ride.
    """

    chain: SubmapChain
    aids: RelativePoseBuffer
    counters: Counters
    texts: list[str] = field(default_factory=list)
    spans: list[tuple[int, int]] = field(default_factory=list)
    begun: HeightAt | None = None

    @property
    def finding(self) -> str:
        """The rides so far in words, or ""."""
        return f"lift rides: {', '.join(self.texts)}" if self.texts else ""

    def after_frame(self, frame: Frame, result: EkfResult) -> EkfResult:
        """Result of a frame, with its pose at the height of the cabin and the submaps that a ride has finished."""
        rides, submaps = self.aids.rides, result.submaps
        if rides.begun:
            submaps += self._begin(frame)
        if rides.ended is not None or rides.is_retracted:
            submaps += self._end(frame, rides.ended)
        if submaps is not result.submaps:
            result = replace(result, pose=self.chain.result(frame.stamp_ns, result.state, result.reason).pose)
        elif rides.height is not None:
            result = replace(result, pose=self._raised(result.pose, rides.height))
        self.chain.is_held_open = rides.is_riding or rides.is_pending
        return result if submaps is result.submaps else replace(result, submaps=submaps)

    def raised(self, pose: PoseEstimate) -> PoseEstimate:
        """A pose since the last frame that maps, at the height that the cabin had there."""
        height = self.aids.rides.height
        return pose if height is None else self._raised(pose, height)

    def end_early(self) -> None:
        """Let the open submap end at the height of a cabin that has just arrived; a ride without end is none."""
        if self.aids.rides.is_riding:
            self._displace(self.aids.rides.conclude())
        self.chain.is_held_open = False

    def after_failure(self) -> None:
        """Go on with the submap that follows one which is given up: the ride, if any, is over."""
        ride = self.aids.rides.ended or self.aids.rides.conclude()
        if ride is not None:
            self._note(ride)
        self.begun = None
        self.chain.is_held_open = False

    def _begin(self, frame: Frame) -> tuple[Submap, ...]:
        """End the submap outside at the height that the cabin has reached already."""
        rides = self.aids.rides
        self.counters.add("lift_rides")
        if self.chain.is_empty or rides.height is None:
            return ()
        self.begun = rides.height
        self.chain.raise_path(rides.begun, self._up)
        self.chain.displace(self.begun.height, self.begun.variance, self._up)
        return self._renew(frame)

    def _end(self, frame: Frame, ride: Ride | None) -> tuple[Submap, ...]:
        self._displace(ride)
        return self._renew(frame)

    def _displace(self, ride: Ride | None) -> None:
        """Let the open submap end at the height of the new storey, or where the ride began if it was none."""
        begun, self.begun = self.begun, None
        height, variance = (0.0, 0.0) if begun is None else (begun.height, begun.variance)
        heights: tuple[HeightAt, ...] = ()
        if ride is None:
            self.counters.add("lift_rides_retracted")
            height = -height
        else:
            self._note(ride)
            heights = tuple(replace(at, height=at.height - height) for at in ride.heights)
            height, variance = ride.height - height, ride.variance
        if variance > 0.0 and self.chain.is_open and not self.chain.is_empty:
            self.chain.raise_path(heights, self._up)
            self.chain.displace(height, variance, self._up)

    def _note(self, ride: Ride) -> None:
        self.spans.append((ride.start_ns, ride.end_ns))
        self.texts.append(f"{ride.text} in {1e-9 * (ride.end_ns - ride.start_ns):.1f} s")
        if refused := self.aids.rides.pressure_refused:
            self.counters.add("pressure_contradicted", refused)
            self.aids.rides.pressure_refused = 0

    def _renew(self, frame: Frame) -> tuple[Submap, ...]:
        """Close the open submap and begin the next at its end, without a common landmark."""
        submaps = self.chain.close()
        self.chain.follow(frame, LandmarkMatches.of_nothing(), LandmarkMatches.of_nothing(), self.aids.up)
        return submaps

    def _raised(self, pose: PoseEstimate, at: HeightAt) -> PoseEstimate:
        height = at.height - (0.0 if self.begun is None else self.begun.height)
        return self._up.seen_from(pose.T).raised(pose, height, at.variance)

    @property
    def _up(self) -> UpDirection:
        inertial = self.aids.inertial
        return UpDirection(inertial.up, inertial.tilt_covariance)
