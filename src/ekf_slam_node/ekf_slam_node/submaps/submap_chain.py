# SPDX-License-Identifier: Apache-2.0
"""The open submap and its place behind those before it (section 7.1): started, extended, closed, followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.odometry.odometry import OdometryChain, UpDirection
from ekf_slam_node.odometry.relative_poses import RelativePoseMeasurement
from ekf_slam_node.odometry.ride_filter import HeightAt
from ekf_slam_node.results import EkfResult, LandmarkView, TrackingState
from ekf_slam_node.submaps.bridging import BridgedPose
from ekf_slam_node.submaps.open_submap import LandmarkMatches, OpenSubmap, candidate_landmarks, with_inherited_ids
from ekf_slam_node.submaps.steps import UpdatedFrame
from ekf_slam_node.submaps.submap_builder import SubmapBuilder
from slam_core.estimation.calibration_error import widened_by_calibration
from slam_core.geometry import FloatArray, compose_covariance
from slam_core.types import PoseEstimate, Submap

_COAST_TIME = 0.5
"""A lost rig is assumed to stop after this time."""
_RESTART_SIGMA_VELOCITY = 1.0
"""Uncertainty of the speed at an independent start, m/s."""
_RESTART_SIGMA_TURN_RATE = 1.0
"""Uncertainty of the turn rate at an independent start, rad/s."""


class SubmapChain:
    """Holds the filter of the open submap, the submap's path, and ``T_odom_submap``.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera, (4, 4).
    session
        Number of the session, see :class:`slam_core.types.Submap`.
    """

    def __init__(self, config: EkfSlamConfig, T_rig_optical: FloatArray, session: int) -> None:
        self._config = config
        self._T_rig_optical = T_rig_optical
        self._session = session
        self._odometry = OdometryChain()
        self._local: OpenSubmap | None = None
        self._builder = SubmapBuilder(config.agent, 0, 0, False, session)
        self._next_index = 0
        self._is_finished = False
        self.is_held_open = False
        """True while the submap must not end, in a lift."""
        self.stamp_ns = 0
        """Stamp of the frame that the filter has reached."""

    @property
    def has_begun(self) -> bool:
        """True if there was a first frame."""
        return self._local is not None

    @property
    def is_open(self) -> bool:
        """True if frames can be added to a submap."""
        return self.has_begun and not self._is_finished

    @property
    def local(self) -> OpenSubmap:
        """The open submap, or the last one if none is open."""
        assert self._local is not None
        return self._local

    # ------------------------------------------------------------------------------------------------------- opening
    def start(self, frame: Frame, pose: PoseEstimate | None = None, up: UpDirection | None = None) -> OpenSubmap:
        """Open a submap at a frame of which nothing is known before: position zero, velocity unknown.

        ``pose``: T_odom_rig at the frame, or None to start where the chain has ended. ``up``: gravity there, if known.
        """
        if pose is None and self.has_begun:
            pose = self.pose(self.stamp_ns)
        if pose is not None:
            self._odometry.advance(pose, up)
        pending = candidate_landmarks(frame, self._T_rig_optical)
        variance = self._config.motion.initial_variance
        local = OpenSubmap.empty(self._config, self._T_rig_optical, np.zeros(6), variance, pending)
        return self._open(local, frame, follows=False)

    def follow(
        self, frame: Frame, seen: LandmarkMatches, measured: LandmarkMatches, up: UpDirection | None = None
    ) -> OpenSubmap:
        """Open the submap that follows the one just closed, at the rig's pose in this frame, and gravity if known."""
        local = self.local
        self._odometry.advance(self.pose(frame.stamp_ns), up)
        if self._config.submap.start == "independent":
            pending = with_inherited_ids(frame, self._T_rig_optical, seen, measured, local.table)
            # The velocity is a starting point with a variance so wide that it carries no information over.
            wide = np.repeat([_RESTART_SIGMA_VELOCITY, _RESTART_SIGMA_TURN_RATE], 3) ** 2
            new = OpenSubmap.empty(self._config, self._T_rig_optical, local.velocity, wide, pending)
        else:
            new = local.given_pose(
                measured.slots, candidate_landmarks(frame, self._T_rig_optical).without(measured.columns)
            )
        return self._open(new, frame, follows=True)

    def _open(self, local: OpenSubmap, frame: Frame, follows: bool) -> OpenSubmap:
        self._local = local
        self._is_finished = False
        self._builder = SubmapBuilder(self._config.agent, self._next_index, frame.stamp_ns, follows, self._session)
        self.stamp_ns = frame.stamp_ns
        return local

    # ------------------------------------------------------------------------------------------------------ extending
    def add_pose(self, stamp_ns: int, standing: bool = False) -> None:
        """Add the filter's pose to the submap's path."""
        self._builder.add_pose(self.local.filter_pose(stamp_ns), standing)
        self.stamp_ns = stamp_ns

    @property
    def is_bridging(self) -> bool:
        """True if poses that no image confirms wait for one that ends them."""
        return self._builder.is_bridging

    def add_bridged_pose(self, stamp_ns: int, motion: RelativePoseMeasurement) -> PoseEstimate:
        """Add the pose after a motion from the filter's pose that no image confirms; returns it as T_odom_rig."""
        before = self.local.filter_pose(self.stamp_ns)
        self._builder.add_bridged_pose(BridgedPose(before, motion, stamp_ns))
        return self._pose_after(stamp_ns, motion.T, motion.covariance)

    def add_located_pose(self, stamp_ns: int, motion: FloatArray, covariance: FloatArray) -> PoseEstimate:
        """Add the pose after a motion (4, 4) from the filter's pose, which a frame shows that maps nothing.

        covariance: (6, 6) of the motion. Returns it as T_odom_rig.
        """
        before = self.local.filter_pose(self.stamp_ns)
        T, own = before.T @ motion, compose_covariance(before.T, before.covariance, motion, covariance)
        self._builder.add_located_pose(PoseEstimate(stamp_ns, T, own))
        return self._pose_after(stamp_ns, motion, covariance)

    def _pose_after(self, stamp_ns: int, motion: FloatArray, covariance: FloatArray) -> PoseEstimate:
        """T_odom_rig after a motion (4, 4), of covariance (6, 6), from the filter's pose, drift included."""
        T = self.local.T
        drifted = compose_covariance(T, self.local.pose_covariance(), motion, covariance)
        return self._odometry.pose(stamp_ns, T @ motion, drifted)

    def is_complete(self, shared: int) -> bool:
        """True if the submap ends with this frame, in which the next one would share so many landmarks with it."""
        return not self.is_held_open and self._builder.is_complete(self.local, self._config.submap, shared)

    @property
    def is_empty(self) -> bool:
        """True if the open submap has no pose beside its first."""
        return self._builder.is_empty

    def raise_path(self, heights: tuple[HeightAt, ...], up: UpDirection) -> None:
        """Raise the poses of the path, which a lift has carried to these heights; ``up`` along the rig's axes."""
        self._builder.raise_path(heights, up.seen_from(self.local.T))

    def displace(self, height: float, variance: float, up: UpDirection) -> None:
        """Move the rig upwards by a height (m) with its variance: the submap ends there, its landmarks stay."""
        self.local.displace(height, variance, up.seen_from(self.local.T))
        self._builder.replace_end(self.local.filter_pose(self.stamp_ns))

    # -------------------------------------------------------------------------------------------------------- closing
    def close(self) -> tuple[Submap, ...]:
        """The open submap as it is now; none if it has but one pose."""
        if self._local is None or self._builder.is_empty:
            return ()
        self._next_index += 1
        return (self._builder.close(self._local),)

    def finish(self) -> tuple[Submap, ...]:
        """Close the open submap; the next one does not follow it."""
        if not self.is_open:
            return ()
        self._is_finished = True
        return self.close()

    # --------------------------------------------------------------------------------------------------------- output
    def pose(self, stamp_ns: int) -> PoseEstimate:
        """T_odom_rig at a stamp not before the filter's.

        Beyond it the rig is assumed to go on for a while and then to stop.
        """
        dt = seconds_between(self.stamp_ns, stamp_ns)
        if dt <= 0.0:
            return self._odometry.pose(stamp_ns, self.local.T, self.local.pose_covariance())
        return self._odometry.pose(stamp_ns, *self.local.predicted_pose(dt, min(dt, _COAST_TIME)))

    def last_sound_pose(self, stamp_ns: int) -> PoseEstimate:
        """The newest finite pose of the open submap's path as T_odom_rig, with another stamp."""
        last = self._builder.last_sound_pose()
        return self._odometry.pose(stamp_ns, last.T, last.covariance)

    def result(
        self,
        stamp_ns: int,
        state: TrackingState,
        reason: str,
        submaps: tuple[Submap, ...] = (),
        updated: UpdatedFrame | None = None,
        pose: PoseEstimate | None = None,
    ) -> EkfResult:
        """The estimate at a stamp, with the submaps that the frame finished and its measurement update, if any.

        ``pose``: T_odom_rig where it is known otherwise than by :meth:`pose`.
        """
        local = self.local
        pose = widened_by_calibration(self.pose(stamp_ns) if pose is None else pose, self._config.calibration)
        result = EkfResult(stamp_ns, pose, local.velocity, local.velocity_covariance(), state, reason, submaps)
        if updated is None:
            return result
        report = updated.report
        return replace(
            result, nis=report.nis, nis_dof=report.dof, landmark_ids=updated.ids, feature_index=updated.index
        )

    def landmark_view(self) -> LandmarkView:
        """The landmarks of the open submap as they are now."""
        table = self.local.table
        positions, covariances = self._odometry.points(*self.local.landmarks())
        return LandmarkView(table.ids.copy(), positions, covariances, table.sightings.copy())
