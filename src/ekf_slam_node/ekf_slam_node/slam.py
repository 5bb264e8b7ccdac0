# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM from frame to frame.

Features in, poses, landmarks and finished submaps out (thesis chapter 6, Algorithm 3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ekf_slam_node.association.linking import Linker
from ekf_slam_node.config import MAX_FRAME_FEATURES, MAX_UPDATE_LANDMARKS, STANDING_FRAMES, EkfSlamConfig
from ekf_slam_node.filtering.correlated_noise import CORRELATED_NOISE_FACTOR, CorrelatedNoise
from ekf_slam_node.filtering.models import Frame, seconds_between
from ekf_slam_node.filtering.noise_monitor import InnovationWatch, NoiseMonitor
from ekf_slam_node.frame_association import MOVING, FrameAssociation
from ekf_slam_node.loss_recovery import LossRecovery
from ekf_slam_node.odometry.relative_poses import (
    ALL,
    RELATIVE_POSE_GATE,
    RelativePoseBuffer,
    RelativePoseMeasurement,
    contradicts,
)
from ekf_slam_node.pose_only import PoseOnlyFrames
from ekf_slam_node.results import EkfResult, LandmarkView, TrackingState
from ekf_slam_node.ride_submaps import RideSubmaps
from ekf_slam_node.submaps.frame_input import LinkedCameras, frame_of_strongest, mounted, usable_features, without_tags
from ekf_slam_node.submaps.missed_frames import MissedFrames
from ekf_slam_node.submaps.motion_checks import (
    StandingDetector,
    inflated_process_noise,
    is_surprising,
    widened,
)
from ekf_slam_node.submaps.open_submap import LandmarkMatches
from ekf_slam_node.submaps.rolling_shutter import RollingShutter
from ekf_slam_node.submaps.steps import LinkedFrame, UpdatedFrame
from ekf_slam_node.submaps.submap_chain import SubmapChain
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, is_rigid_transform, make_transform
from slam_core.types import Counters, Features, ImuSample, OdometryReading, PressureReading, RelativeMotion, Submap

_PATIENCE_NS = 1_000_000_000
"""Time after the end of a map for which a new one waits for a frame that maps."""


class EkfSlam:
    """Builds submaps from features, one frame after the other.

    A frame is *linked* to the previous one first: its features are associated with the landmarks of the filter and
    with the previous frame's other features. Those confirmed in this way become landmarks at the previous pose, from
    the previous measurement; only then does the filter move on to the new frame and use the new measurement. So every
    measurement is used once, and nothing that was seen only once burdens the filter.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera, (4, 4); by default at the rig's origin, looking along its X axis. Of a rig with several
        cameras: of one of them; :meth:`mount` tells where all are.
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
        self._mountings: dict[str, FloatArray] = {}
        self._linker = Linker(config.association, T_rig_optical)
        self._shutter = RollingShutter(T_rig_optical, (config.measurement.readout, config.measurement.sigma_readout))
        self.counters = Counters()
        self.session = session
        self._forget()

    def mount(self, frame_id: str, T_rig_optical: FloatArray) -> None:
        """Say where on the rig the optical frame of one of several cameras sits, (4, 4), before its first features."""
        if not is_rigid_transform(T_rig_optical):
            raise ValueError(f"T_rig_optical of {frame_id} must be a rigid transform (4, 4), got {T_rig_optical}")
        self._mountings[frame_id] = T_rig_optical

    def start_session(self) -> tuple[Submap, ...]:
        """Begin anew with the next frame, whatever its stamp; the open submap is closed and returned."""
        submaps = self.finish()
        self.session += 1
        self._forget()
        return submaps

    def _forget(self) -> None:
        config = self.config
        self._aids = RelativePoseBuffer(config.motion, config.imu, config.odometry, config.ride)
        self._noise = NoiseMonitor()
        self._innovations = InnovationWatch()
        self._common = CorrelatedNoise(CORRELATED_NOISE_FACTOR)
        self._chain = SubmapChain(self.config, self._T_rig_optical, self.session)
        self._next_id = 0
        self._newest_stamp_ns = 0
        self._tags: Frame | None = None
        self._linked_cameras = LinkedCameras()
        self._standing = StandingDetector(STANDING_FRAMES, self.config.association.gate)
        missed = MissedFrames(self._linker, self._T_rig_optical, self.config.motion)
        known = self._chain, self._aids, self._linker, self._shutter
        self._association = FrameAssociation(self.config, *known, self.counters)
        self._rides = RideSubmaps(self._chain, self._aids, self.counters)
        located = self._chain, self._association, self._aids, self._common, self._rides
        self._pose_only = PoseOnlyFrames(*located, self.counters, self._map)
        self._recovery = LossRecovery(self.config, self._chain, self._aids, missed, self.counters, self._advance)

    # --------------------------------------------------------------------------------------------------------- input
    def process(self, features: Features, motion: RelativeMotion | None = None) -> EkfResult:
        """One frame of features, with the motion since the previous one where something else has measured it.

        Bad input is counted in ``counters`` and named in the result's reason, never raised.
        """
        if motion is not None:
            self.process_motion(motion)
        problem = self._problem_with(features)
        if problem:
            return self._chain.result(self._newest_stamp_ns, TrackingState.DEGRADED, problem)
        self._newest_stamp_ns = features.stamp_ns
        features, tags = without_tags(features)
        place = features.cameras, self._T_rig_optical, self._mountings
        self._tags = None if tags is None else mounted(tags, *place)
        usable = usable_features(features)
        self.counters.add("features_unusable", int(len(features) - usable.sum()))
        frame = self._noise.corrected(mounted(frame_of_strongest(features, usable, MAX_FRAME_FEATURES), *place))
        if not self._chain.is_open:
            if features.is_pose_only and self._chain.has_begun and frame.stamp_ns - self._chain.stamp_ns < _PATIENCE_NS:
                return self._chain.result(frame.stamp_ns, TrackingState.DEGRADED, "waits for a frame that maps")
            self._linked_cameras.take(frame)
            return self._recovery.begin(frame)
        return self._pose_only.locate(frame) if features.is_pose_only else self._map(frame)

    def _map(self, frame: Frame) -> EkfResult:
        """One frame of Algorithm 3, and what rides and failures make of it."""
        slips = self._aids.external.slips
        self._aids.rides.forget_events()
        try:
            result = self._rides.after_frame(frame, self._advance(frame))
        except np.linalg.LinAlgError:
            self._rides.after_failure()
            return self._recovery.abandon(frame, "a matrix could not be factored")
        if self._aids.external.slips > slips:
            self.counters.add("odometry_slips", self._aids.external.slips - slips)
        if not self._chain.local.is_finite:
            return self._recovery.abandon(frame, "the estimate was no longer finite", result)
        return result

    def _problem_with(self, features: Features) -> str:
        """Reason for which a frame cannot be used at all, or ""."""
        if not self._chain.has_begun:
            return ""
        if features.stamp_ns <= self._newest_stamp_ns:
            self.counters.add("stamp_not_newer")
            return "frame is not newer than the last"
        size, known = features.descriptors.shape[1], self._chain.local.descriptor_size
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
        if self.config.imu.use == "off":
            return
        if not self._aids.add_imu(sample):
            self.counters.add("imu_rejected")

    def process_odometry(self, reading: OdometryReading) -> None:
        """A pose of an external odometry, in the order of the stamps, before the frames that come after it."""
        if reason := self._aids.add_odometry(reading):
            self.counters.add(f"odometry_{reason.replace(' ', '_')}")

    def process_pressure(self, reading: PressureReading) -> None:
        """A reading of a barometer, in the order of the stamps, before the frames that come after it."""
        if reason := self._aids.rides.pressure.add(reading):
            self.counters.add(f"pressure_{reason.replace(' ', '_')}")

    @property
    def rides_finding(self) -> str:
        """The heights of the lift rides so far, or ""."""
        return self._rides.finding

    @property
    def ride_spans(self) -> list[tuple[int, int]]:
        """First and last stamp (ns) of each lift ride so far."""
        return self._rides.spans

    @property
    def diagnostic(self) -> str:
        """Complaint about the IMU, the odometry or the association, or ""."""
        return self._aids.inertial.diagnostic or self._aids.external.diagnostic or self._innovations.diagnostic

    @property
    def odometry_finding(self) -> str:
        """The calibration of an external odometry as it was learnt, or ""."""
        return self._aids.external.finding

    @property
    def readout_s(self) -> tuple[float, float]:
        """Time from the picture's first row to its last and its standard deviation, s; zeros where nothing is known.

        The time is 0 where rows are exposed at once.
        """
        return self._shutter.readout_s, self._shutter.sigma_s

    @property
    def readout_seen_s(self) -> tuple[float, float]:
        """That time as the frames alone show it, certain or not, and its standard error, s; zeros for too few."""
        return self._shutter.seen_s

    @property
    def imu_time_offset_s(self) -> tuple[float, float]:
        """Time to be added to the IMU's stamps, as learnt, and its standard deviation, s; zeros without an IMU."""
        inertial = self._aids.inertial
        return (inertial.time_offset, inertial.sigma_time_offset) if self._aids.newest_stamp_ns >= 0 else (0.0, 0.0)

    def landmark_view(self) -> LandmarkView:
        """The landmarks of the open submap after the newest frame."""
        return self._chain.landmark_view()

    def finish(self) -> tuple[Submap, ...]:
        """Close the open submap; the next frame begins a new one that does not follow it.

        It ends where an odometry has carried the rig to, if the last frames had no link.
        """
        before = self._pose_only.advance() if self._chain.is_open else None
        self._recovery.end_where_odometry_is()
        self._rides.end_early()
        return (() if before is None else before.submaps) + self._chain.finish()

    # ----------------------------------------------------------------------------------------------------- Algorithm 3
    def _advance(self, frame: Frame) -> EkfResult:
        """FrameLink, augment, predict, update, then maintain the landmarks or close the submap."""
        dt = seconds_between(self._chain.stamp_ns, frame.stamp_ns)
        aid = self._aids.between(self._chain.stamp_ns, frame.stamp_ns)
        linked = self._link(frame, dt, aid)
        if linked is None and (before := self._pose_only.advance()) is not None:
            result = self._advance(frame)
            return replace(result, submaps=before.submaps + result.submaps)
        self._pose_only.newest = None
        if linked is None and aid is not None and aid.rows == ALL and aid.source == "scans":
            return self._recovery.dead_reckon(frame, dt, aid)
        bridge = None
        if linked is None or self._chain.is_bridging:
            bridge = self._aids.bridge(self._chain.stamp_ns, frame.stamp_ns)
        if linked is None and bridge is not None:
            linked = self._link(frame, dt, bridge)
        if linked is None and self._linked_cameras.go_on_without(frame):
            self.counters.add("frames_of_one_camera_unlinked")
            return self._chain.result(frame.stamp_ns, TrackingState.OK, "")
        if linked is None:
            return self._recovery.track_lost(frame, bridge)
        self._linked_cameras.take(frame)
        if bridge is not None:
            self._chain.add_bridged_pose(frame.stamp_ns, bridge)
        if self._standing.add(linked):
            return self._zero_velocity_update(linked)
        seen = self._augment(linked)
        self._predict(linked)
        updated = self._update(linked, seen)
        self._measure_tags(linked, updated)
        submaps = self._close(linked, seen, updated) if updated.closes else self._maintain(linked, updated)
        return self._chain.result(frame.stamp_ns, *updated.state(linked.link), submaps, updated)

    def _link(self, frame: Frame, dt: float, aid: RelativePoseMeasurement | None) -> LinkedFrame | None:
        """Associate a frame with what is known, and learn its noise from the pairs; None if nothing fits."""
        found = self._association.of(frame, dt, aid)
        if found is None:
            return None
        link, expected = found.link, found.expected
        if link.moving:
            self.counters.add(f"frames_with_{MOVING}")
            self.counters.add(f"features_on_{MOVING}", link.moving)
        known = None if aid is None else found.prior.T
        measured = self._noise.learn(frame, link.variance_scale)
        frame = self._shutter.corrected(measured, dt, link.T if known is None else known)
        if link.wrong is not None:
            wider = frame.variance + link.wrong
            self._innovations.add(float(np.max(link.variance_scale[:2] * (frame.variance / wider).mean(axis=0)[:2])))
            frame = replace(frame, variance=wider)
        self._common.learn(frame.side_by_side(gap=1.0)[link.columns], link.error[:, :2], frame.camera.width)
        surprising = is_surprising(link, expected, self.config.association.gate)
        common = self._common.sigma(frame)
        aid = None if aid is None else widened(aid, common)
        return LinkedFrame(frame, measured, dt, link, aid, common, surprising, len(self._chain.local.table))

    def _augment(self, linked: LinkedFrame) -> LandmarkMatches:
        """Add the landmarks that the frame confirms, at the previous pose; returns all landmarks that it sees."""
        # A surprising motion rests on these pairs alone: all of them are worth their cost.
        config = self.config
        wanted = MAX_UPDATE_LANDMARKS if linked.surprising else config.landmark.target_in_view
        new_ids = np.arange(self._next_id, self._next_id + len(linked.link.rows))
        self._next_id += len(new_ids)
        return self._chain.local.initialise_landmarks(linked.frame, linked.link, wanted, new_ids)

    def _predict(self, linked: LinkedFrame) -> None:
        """Time update, linearised at the motion found, and measurement of the motion by other sensors.

        Over a large step the motion found and the predicted one are far apart.
        """
        local, link, aid, sigma = self._chain.local, linked.link, linked.aid, self.config.motion.sigma
        if linked.surprising:
            sigma = inflated_process_noise(link.T, local.velocity, sigma, linked.dt)
        step = local.predict(linked.dt, sigma, link.T)
        if aid is not None:
            fits = not contradicts(aid, link.T, linked.motion_covariance, RELATIVE_POSE_GATE)
            self._recovery.count_aid(fits and local.apply_motion(step, aid, link.T))
        self._tell_imu(linked)

    def _tell_imu(self, linked: LinkedFrame) -> None:
        """Let the IMU's filter learn from the motion that the images alone show."""
        T, covariance = linked.link.T, linked.motion_covariance
        if not self._aids.moved(self._chain.stamp_ns, linked.frame.stamp_ns, T, covariance):
            self.counters.add("imu_contradicted")

    def _update(self, linked: LinkedFrame, seen: LandmarkMatches) -> UpdatedFrame:
        """Measurement update; in a submap's last frame with half of the landmarks, the others start the next one."""
        local, closes = self._chain.local, self._chain.is_complete(len(seen))
        chosen = seen.every_second() if closes and self.config.submap.start == "independent" else seen
        report, measured = local.measure(linked.frame, chosen, linked.common, closes)
        if not report.applied:
            self.counters.add("updates_failed")
        local.drift_by(linked.common)
        self._recovery.arrive(linked.frame)
        ids, index = local.table.ids[measured.slots], linked.frame.index[measured.columns]
        self._shutter.learn(linked.measured, ids, measured.columns, linked.link.T, linked.dt)
        return UpdatedFrame(report, measured, closes, ids, index)

    def _measure_tags(self, linked: LinkedFrame, updated: UpdatedFrame) -> None:
        """Measure the frame's fiducial tags; where the submap ends, the pose bears the common error already."""
        if self._tags is None or self._tags.stamp_ns != linked.frame.stamp_ns:
            return
        tags = self._shutter.corrected(self._tags, linked.dt, linked.link.T)
        report = self._chain.local.measure_tags(tags, np.zeros(6) if updated.closes else linked.common)
        self.counters.add("tags_measured", report.measured)
        if report.elsewhere:
            self.counters.add("tags_elsewhere", report.elsewhere)
        if report.moved:
            self.counters.add("tags_moved", report.moved)

    def _maintain(self, linked: LinkedFrame, updated: UpdatedFrame) -> tuple[Submap, ...]:
        """Keep the frame's other features for the next one and remove landmarks that cannot be relied on."""
        self._chain.local.remember(linked.frame, updated.measured, linked.link, linked.landmarks)
        self._chain.local.prune_landmarks(linked.frame, updated.measured)
        return ()

    def _close(self, linked: LinkedFrame, seen: LandmarkMatches, updated: UpdatedFrame) -> tuple[Submap, ...]:
        """Finish the submap and open the one that follows, at the rig's pose in this frame."""
        submaps = self._chain.close()
        self._chain.follow(linked.frame, seen, updated.measured, self._aids.up)
        return submaps

    # ------------------------------------------------------------------------------------------------------- standing
    def _zero_velocity_update(self, linked: LinkedFrame) -> EkfResult:
        """The rig stands: neither pose nor map change.

        If it creeps, the frames link to the landmarks at an ever larger motion, which ends the standing.
        """
        self._chain.local.stand()
        self._tell_imu(linked)
        self.counters.add("frames_standing")
        self._recovery.arrive(linked.frame, standing=True)
        return self._chain.result(linked.frame.stamp_ns, TrackingState.OK, "")
