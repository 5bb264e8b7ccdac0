# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM from frame to frame.

Features in, poses, landmarks and finished submaps out (thesis chapter 6, Algorithm 3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ekf_slam_node.aids import ALL, Aid, MotionAids, aid_error, contradicts
from ekf_slam_node.calibration import in_doubt
from ekf_slam_node.candidates import motion_prior
from ekf_slam_node.common_error import CommonError
from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.ekf import Ekf, TimeUpdate
from ekf_slam_node.landmarks import LandmarkBook, Pending
from ekf_slam_node.linking import Link, Linker
from ekf_slam_node.local_map import LocalMap, Sight, inheriting, pending_of
from ekf_slam_node.models import CORE_DIM, Frame, frame_from_features, relative_motion
from ekf_slam_node.motion_checks import aided, is_still, is_surprising, widened
from ekf_slam_node.noise_monitor import NoiseMonitor
from ekf_slam_node.odometry import OdometryChain
from ekf_slam_node.results import EkfResult, LandmarkView, TrackingState
from ekf_slam_node.steps import LinkedFrame, UpdatedFrame
from ekf_slam_node.submap_builder import SubmapBuilder, conditional_start
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, boxminus, is_rigid_transform, make_transform
from slam_core.types import Counters, Features, ImuSample, PoseEstimate, RelativeMotion, Submap

_STANDING_VELOCITY = np.repeat([0.02, np.radians(0.5)], 3)
"""Standard deviations (m/s, rad/s) of the velocities of a rig that stands."""

_LONGEST_STEP_S = 10.0
"""A gap counts as no longer than this: the model says nothing about it any more, and larger variances cost digits."""

_FARTHEST_M, _LARGEST_PX, _SMALLEST_SIGMA = 1e5, 1e6, 1e-6
"""Limits of what can be a feature: depth m, pixel, standard deviation px or m."""


class EkfSlam:
    """Builds submaps from features, one frame after the other.

    A frame is *linked* to the previous one first: its features are associated with the landmarks of the filter and
    with the previous frame's other features. Those confirmed in this way become landmarks at the previous pose, from
    the previous measurement; only then does the filter move on to the new frame and use the new measurement. So every
    measurement is used once, and nothing that was seen only once burdens the filter.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera, (4, 4); by default at the rig's origin, looking along its X axis.
    session
        Number of the first session, see :class:`slam_core.types.Submap`.
    """

    def __init__(self, config: EkfSlamConfig, T_rig_optical: FloatArray | None = None, session: int = 0) -> None:
        if T_rig_optical is None:
            T_rig_optical = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))
        if not is_rigid_transform(T_rig_optical):
            raise ValueError(f"T_rig_optical must be a rigid transform (4, 4), got {T_rig_optical}")
        self.config = config
        self._T_rig_optical = T_rig_optical
        self._linker = Linker(config.association, T_rig_optical)
        self._sigma = np.repeat([config.motion.sigma_acceleration, config.motion.sigma_angular_acceleration], 3)
        self.counters = Counters()
        self.session = session
        self._forget()

    def start_session(self) -> tuple[Submap, ...]:
        """Begin anew with the next frame, whatever its stamp; the open submap is closed and returned."""
        submaps = self.finish()
        self.session += 1
        self._forget()
        return submaps

    def _forget(self) -> None:
        self._aids = MotionAids(self.config.motion)
        self._noise = NoiseMonitor(self.config.measurement)
        self._common = CommonError(self.config.measurement.common_error)
        self._odometry = OdometryChain()
        self._map: LocalMap | None = None
        self._builder = SubmapBuilder(self.config.agent, 0, 0, False, self.session)
        self._next_submap = 0
        self._next_id = 0
        self._stamp_ns = 0
        self._newest_stamp_ns = 0
        self._is_finished = False
        self._missed: Frame | None = None
        self._lost_frames = 0
        self._still_frames = 0

    # --------------------------------------------------------------------------------------------------------- input
    def process(self, features: Features, motion: RelativeMotion | None = None) -> EkfResult:
        """One frame of features, with the motion since the previous one where something else has measured it.

        Bad input is counted in ``counters`` and named in the result's reason, never raised.
        """
        if motion is not None:
            self.process_motion(motion)
        problem = self._problem_with(features)
        if problem:
            return self._report(self._newest_stamp_ns, TrackingState.DEGRADED, problem)
        self._newest_stamp_ns = features.stamp_ns
        frame = self._noise.corrected(self._usable(features))
        if self._map is None or self._is_finished:
            return self._begin(frame)
        try:
            result = self._advance(self._map, frame)
        except np.linalg.LinAlgError:
            return self._abandon(frame, "a matrix could not be factored")
        return result if self._map.ekf.is_finite else self._abandon(frame, "the estimate was no longer finite", result)

    def _problem_with(self, features: Features) -> str:
        """Why a frame cannot be used at all, or ""."""
        if self._map is None:
            return ""
        if features.stamp_ns <= self._newest_stamp_ns:
            self.counters.add("stamp_not_newer")
            return "frame is not newer than the last"
        size, known = features.descriptors.shape[1], self._map.descriptor_size
        if len(features) and known not in (0, size):
            self.counters.add("descriptors_of_another_size")
            return f"descriptors have {size} columns, the map's have {known}"
        return ""

    def process_motion(self, motion: RelativeMotion) -> None:
        """A motion of the rig, as scan registration measures it; stamps need not be those of the frames."""
        if not self._aids.add_motion(motion):
            self.counters.add("motion_rejected")

    def process_imu(self, sample: ImuSample) -> None:
        """A reading of an IMU, in the order of the stamps, before the frames that come after it."""
        if self.config.motion.imu == "off":
            return
        if not self._aids.add_imu(sample):
            self.counters.add("imu_rejected")

    def finish(self) -> tuple[Submap, ...]:
        """Close the open submap; the next frame begins a new one that does not follow it."""
        if self._map is None or self._is_finished:
            return ()
        self._is_finished = True
        return self._closed()

    def _usable(self, features: Features) -> Frame:
        limits = self.config.measurement
        sigma = np.column_stack([features.sigma_uv, features.sigma_depth])
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(features.uv).all(axis=1) & np.isfinite(features.depth) & np.isfinite(sigma).all(axis=1)
            usable &= (features.depth > 0.05) & (features.depth < _FARTHEST_M) & (sigma > _SMALLEST_SIGMA).all(axis=1)
            usable &= np.abs(features.uv).max(axis=1, initial=0.0) < _LARGEST_PX
            usable &= features.sigma_depth < limits.max_relative_depth_sigma * features.depth
            usable &= np.isfinite(features.descriptors).all(axis=1)
        self.counters.add("features_unusable", int(len(features) - usable.sum()))
        index = np.flatnonzero(usable)
        strongest = np.argsort(-features.response[index], kind="stable")[: limits.max_features]
        return frame_from_features(features, np.sort(index[strongest]), limits.min_sigma_px, limits.min_sigma_depth)

    # --------------------------------------------------------------------------------------------------- frame by frame
    def _advance(self, local: LocalMap, frame: Frame) -> EkfResult:
        """Algorithm 3: link, augment, predict, update, then maintain the landmarks or close the submap."""
        dt = _seconds(self._stamp_ns, frame.stamp_ns)
        aid = self._aids.between(self._stamp_ns, frame.stamp_ns)
        linked = self._link(local, frame, dt, aid)
        if linked is None:
            return self._miss(frame) if aid is None or aid.rows != ALL else self._coast(local, frame, dt, aid)
        if self._is_standing(linked):
            return self._stand(local, linked)
        landmarks_before = len(local.book)
        seen = self._augment(local, linked)
        self._predict(local, linked)
        updated = self._update(local, linked, seen)
        submaps: tuple[Submap, ...] = ()
        if updated.closes:
            submaps = self._close(local, linked.frame, seen, updated)
        else:
            local.remember(linked.frame, updated.measured, linked.link, landmarks_before)
            local.tidy(linked.frame, updated.measured)
        return self._report(frame.stamp_ns, *updated.state, submaps, updated)

    def _link(self, local: LocalMap, frame: Frame, dt: float, aid: Aid | None) -> LinkedFrame | None:
        """Associate a frame with what is known, and learn its noise from the pairs; None if nothing fits."""
        velocity_covariance = local.ekf.covariance.head(CORE_DIM)[6:CORE_DIM, 6:]
        expected = motion_prior(local.ekf.velocity, velocity_covariance, self._sigma, dt)
        link = self._linker.link(local.candidates(), frame, aided(expected, aid))
        if link is None:
            return None
        frame = self._noise.learn(frame, link.excess)
        self._common.learn(frame.z[link.columns, :2], link.error[:, :2], frame.camera.width)
        surprising = is_surprising(link, expected, self.config.association.gate)
        common = self._common.sigma(frame)
        return LinkedFrame(frame, dt, link, None if aid is None else widened(aid, common), common, surprising)

    def _augment(self, local: LocalMap, linked: LinkedFrame) -> Sight:
        """Add the landmarks that the frame confirms, at the previous pose; returns all landmarks that it sees."""
        # A surprising motion rests on these pairs alone: all of them are worth their cost.
        config = self.config
        wanted = config.measurement.max_observations if linked.surprising else config.landmark.target_in_view
        new_ids = np.arange(self._next_id, self._next_id + len(linked.link.rows))
        self._next_id += len(new_ids)
        return local.confirm(linked.frame, linked.link, wanted, new_ids)

    def _predict(self, local: LocalMap, linked: LinkedFrame) -> None:
        """Time update, linearised at the motion found, and measurement of the motion by other sensors.

        Over a large step the motion found and the predicted one are far apart.
        """
        link, aid = linked.link, linked.aid
        sigma = self._explaining_sigma(local, link, linked.dt) if linked.surprising else self._sigma
        step = local.ekf.time_update(linked.dt, sigma, link.T)
        local.ekf.apply_time_update(step)
        if aid is None:
            return
        if contradicts(aid, link.T, linked.motion_covariance, self.config.motion.aid_gate):
            self.counters.add("aids_rejected")
        else:
            self._use_aid(local, step, aid, link.T)
        self._aids.learn_bias(aid, link.T, linked.motion_covariance, linked.dt)

    def _update(self, local: LocalMap, linked: LinkedFrame, seen: Sight) -> UpdatedFrame:
        """Measurement update; in a submap's last frame with half of the landmarks, the others start the next one."""
        closes = self._builder.is_complete(local.ekf, self.config.submap, len(seen))
        common, chosen = linked.common, seen
        if closes:
            # The next submap starts at the camera's pose in this frame, its error included: so does this one end there.
            local.ekf.shake(common)
            common = np.zeros(6)
            chosen = seen.every_second() if self.config.submap.start == "independent" else seen
        report, measured = local.measure(linked.frame, chosen, common)
        if not report.applied:
            self.counters.add("updates_failed")
        self._builder.add_pose(linked.frame.stamp_ns, local.ekf)
        self._reached(linked.frame)
        ids, index = local.book.ids[measured.slots], linked.frame.index[measured.columns]
        return UpdatedFrame(report, measured, closes, ids, index)

    def _close(self, local: LocalMap, frame: Frame, seen: Sight, updated: UpdatedFrame) -> tuple[Submap, ...]:
        """Finish the submap and open the one that follows, at the rig's pose in this frame."""
        submaps = self._closed()
        self._succeed(local, frame, seen, updated.measured)
        return submaps

    def _explaining_sigma(self, local: LocalMap, link: Link, dt: float) -> FloatArray:
        """Acceleration noise with which the model can explain the motion found."""
        needed = 2.0 * boxminus(link.T, relative_motion(local.ekf.velocity, dt)) / dt**2
        sizes = np.repeat(np.linalg.norm(needed.reshape(2, 3), axis=1), 3)
        return np.asarray(np.maximum(self._sigma, sizes))

    # ------------------------------------------------------------------------------------------------------- standing
    def _is_standing(self, linked: LinkedFrame) -> bool:
        """Whether the rig has not moved for some frames, this one included."""
        still = is_still(linked, self.config.association.gate)
        self._still_frames = self._still_frames + 1 if still else 0
        return 0 < self.config.motion.standing_frames < self._still_frames

    def _stand(self, local: LocalMap, linked: LinkedFrame) -> EkfResult:
        """The rig stands: neither pose nor map change.

        If it creeps, the frames link to the landmarks at an ever larger motion, which ends the standing.
        """
        local.ekf.stop(_STANDING_VELOCITY)
        if linked.aid is not None:
            self._aids.learn_bias(linked.aid, linked.link.T, linked.motion_covariance, linked.dt)
        self.counters.add("frames_standing")
        self._builder.add_pose(linked.frame.stamp_ns, local.ekf, standing=True)
        self._reached(linked.frame)
        return self._report(linked.frame.stamp_ns, TrackingState.OK, "")

    def _use_aid(self, local: LocalMap, step: TimeUpdate, aid: Aid, T_previous_now: FloatArray) -> None:
        """Measure the step just predicted, unless the aid contradicts the prediction."""
        rotation = step.T[:3, :3] @ T_previous_now[:3, :3].T
        error, covariance = aid_error(aid, T_previous_now, rotation)
        if local.ekf.update_increment(step, error, covariance, aid.rows, self.config.motion.aid_gate).applied:
            self.counters.add("aids_used")
        else:
            self.counters.add("aids_rejected")

    def _reached(self, frame: Frame) -> None:
        self._stamp_ns = frame.stamp_ns
        self._missed = None
        self._lost_frames = 0
        self._aids.forget_before(frame.stamp_ns)

    # ------------------------------------------------------------------------------------------------ without a link
    def _coast(self, local: LocalMap, frame: Frame, dt: float, aid: Aid) -> EkfResult:
        """No link, but something else has measured the motion: go with it."""
        step = local.ekf.time_update(dt, self._sigma, aid.T)
        local.ekf.apply_time_update(step)
        self._use_aid(local, step, aid, aid.T)
        local.ekf.settle()
        self._builder.add_pose(frame.stamp_ns, local.ekf)
        self._reached(frame)
        local.pending = pending_of(frame, self._T_rig_optical)
        return self._report(frame.stamp_ns, TrackingState.DEGRADED, "no visual association, moved by odometry alone")

    def _miss(self, frame: Frame) -> EkfResult:
        """No link: nothing is mapped.

        The filter stays at the last linked frame, so that the old map can be found again.
        """
        self.counters.add("frames_lost")
        self._lost_frames += 1
        if self._lost_frames >= self.config.submap.lost_frames and self._links_to_missed(frame):
            return self._restart(frame)
        self._missed = frame
        reason = f"{len(frame)} features, fewer than {self.config.association.min_inliers} associations"
        return self._report(frame.stamp_ns, TrackingState.LOST, reason)

    def _links_to_missed(self, frame: Frame) -> bool:
        missed = self._missed
        if missed is None:
            return False
        dt = _seconds(missed.stamp_ns, frame.stamp_ns)
        prior = motion_prior(np.zeros(6), np.diag(self._first_variance()), self._sigma, dt)
        return self._linker.link(pending_of(missed, self._T_rig_optical).candidates, frame, prior) is not None

    def _restart(self, frame: Frame) -> EkfResult:
        """The old map is not found again, but two missed frames agree: a new submap begins at the first of them."""
        missed = self._missed
        assert missed is not None
        pose = self._pose(missed.stamp_ns)
        submaps = self._closed()
        self._odometry.advance(pose)
        result = self._advance(self._start(missed), frame)
        return replace(result, submaps=submaps + result.submaps)

    def _abandon(self, frame: Frame, reason: str, result: EkfResult | None = None) -> EkfResult:
        """Give up the open submap, which cannot be trusted any more, and begin a new one at this frame."""
        self.counters.add("submaps_abandoned")
        last = self._builder.last_sound_pose()
        self._odometry.advance(self._odometry.pose(frame.stamp_ns, last.T, last.covariance))
        self._start(frame)
        reason = f"{reason}: the open submap is given up, a new one begins"
        return self._report(frame.stamp_ns, TrackingState.LOST, reason, () if result is None else result.submaps)

    # ------------------------------------------------------------------------------------------------------- submaps
    def _begin(self, frame: Frame) -> EkfResult:
        if self._map is not None:
            self._odometry.advance(self._pose(self._stamp_ns))
            self._is_finished = False
        self._start(frame)
        if len(frame) < self.config.association.min_inliers:
            return self._report(frame.stamp_ns, TrackingState.DEGRADED, f"only {len(frame)} features to begin with")
        return self._report(frame.stamp_ns, TrackingState.OK, "")

    def _start(self, frame: Frame) -> LocalMap:
        """A submap at a frame of which nothing is known before: position zero, velocity unknown."""
        pending = pending_of(frame, self._T_rig_optical)
        local = self._empty_map(frame, np.zeros(6), self._first_variance(), pending)
        self._open(local, frame, follows=False)
        return local

    def _empty_map(self, frame: Frame, velocity: FloatArray, variance: FloatArray, pending: Pending) -> LocalMap:
        covariance = np.zeros((CORE_DIM, CORE_DIM))
        covariance[6:, 6:] = np.diag(variance)
        ekf = Ekf(velocity, covariance, self.config.error == "invariant")
        return LocalMap(self.config, self._T_rig_optical, ekf, LandmarkBook(frame.descriptors.shape[1]), pending)

    def _open(self, local: LocalMap, frame: Frame, follows: bool) -> None:
        self._map = local
        self._builder = SubmapBuilder(self.config.agent, self._next_submap, frame.stamp_ns, follows, self.session)
        self._reached(frame)

    def _first_variance(self) -> FloatArray:
        motion = self.config.motion
        return np.repeat([motion.sigma_initial_velocity, motion.sigma_initial_turn_rate], 3) ** 2

    def _succeed(self, local: LocalMap, frame: Frame, sight: Sight, used: Sight) -> None:
        """Open the submap that follows, at the rig's pose in this frame."""
        self._odometry.advance(self._pose(frame.stamp_ns))
        if self.config.submap.start == "independent":
            pending = inheriting(frame, self._T_rig_optical, sight, used, local.book)
            config = self.config.submap
            # The velocity is a starting point with a variance so wide that it carries no information over.
            wide = np.repeat([config.restart_sigma_velocity, config.restart_sigma_turn_rate], 3) ** 2
            following = self._empty_map(frame, local.ekf.velocity, wide, pending)
        else:
            ekf = conditional_start(local.ekf, used.slots, self.config.error == "invariant")
            following = LocalMap(
                self.config, self._T_rig_optical, ekf, local.book.select(used.slots),
                pending_of(frame, self._T_rig_optical).without(used.columns),
            )  # fmt: skip
        self._open(following, frame, follows=True)

    def _closed(self) -> tuple[Submap, ...]:
        if self._map is None or self._builder.is_empty:
            return ()
        self._next_submap += 1
        return (self._builder.close(self._map.ekf, self._map.book),)

    # -------------------------------------------------------------------------------------------------------- output
    def _pose(self, stamp_ns: int) -> PoseEstimate:
        """T_odom_rig at a stamp not before the filter's.

        Beyond it the rig is assumed to go on for a while and then to stop.
        """
        assert self._map is not None
        ekf = self._map.ekf
        dt = _seconds(self._stamp_ns, stamp_ns)
        if dt <= 0.0:
            return self._odometry.pose(stamp_ns, ekf.T, ekf.pose_covariance())
        T = ekf.T @ relative_motion(ekf.velocity, min(dt, self.config.motion.coast_time))
        return self._odometry.pose(stamp_ns, T, ekf.time_update(dt, self._sigma).head[:6, :6])

    def _report(
        self, stamp_ns: int, state: TrackingState, reason: str, submaps: tuple[Submap, ...] = (),
        updated: UpdatedFrame | None = None,
    ) -> EkfResult:  # fmt: skip
        assert self._map is not None
        ekf = self._map.ekf
        result = EkfResult(
            stamp_ns, in_doubt(self._pose(stamp_ns), self.config.calibration), ekf.velocity,
            ekf.covariance.head(CORE_DIM)[6:CORE_DIM, 6:], state, reason, submaps, self._landmark_view(),
        )  # fmt: skip
        if updated is None:
            return result
        report = updated.report
        return replace(
            result, nis=report.nis, nis_dof=report.dof, landmark_ids=updated.ids, feature_index=updated.index
        )

    def _landmark_view(self) -> LandmarkView:
        assert self._map is not None
        ekf, book = self._map.ekf, self._map.book
        blocks = ekf.covariance.blocks(CORE_DIM + 3 * np.arange(len(ekf.landmarks)))
        positions, covariances = self._odometry.points(ekf.landmarks, blocks)
        return LandmarkView(book.ids.copy(), positions, covariances, book.sightings.copy(), book.descriptors.copy())


def _seconds(start_stamp_ns: int, end_stamp_ns: int) -> float:
    return min((end_stamp_ns - start_stamp_ns) * 1e-9, _LONGEST_STEP_S)
