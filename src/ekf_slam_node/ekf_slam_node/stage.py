# SPDX-License-Identifier: Apache-2.0
"""EKF-SLAM of one rig without ROS: features, motions and IMU readings in any order in, results in order of stamps out.

    features ----------------> wait until all others have reached their stamp -> EkfSlam -> result, finished submaps
    motions, IMU, odometry --^

Nothing waits for a barometer, whose readings are few and late: a frame uses those up to its stamp that have come.

Of a rig with several cameras the features of one moment are joined first (:mod:`slam_core.nodes.rig_groups`).

A stream that falls silent holds nothing up: the filter goes on without it, says so in its state, and uses it again when
it comes back.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.frame_association import MOVING
from ekf_slam_node.results import EkfResult, LandmarkView, TrackingState
from ekf_slam_node.slam import EkfSlam
from slam_core.config import parameter
from slam_core.frame_tree import FrameTree
from slam_core.nodes.awaited_streams import PATIENCE, AwaitedStreams
from slam_core.nodes.rig_groups import RigGroups
from slam_core.rig_features import features_of_rig
from slam_core.types import Counters, Features, ImuSample, OdometryReading, PressureReading, RelativeMotion, Submap

MOTION, IMU, ODOMETRY = STREAMS = "motion", "imu", "odometry"
_SIGNIFICANT_OFFSET_S, _SIGNIFICANT_SIGMAS = 3e-3, 4.0
"""A difference of the clocks so large is told."""


@dataclass(frozen=True)
class FilterConfig(EkfSlamConfig):
    """The filter's parameters, and which other streams its frames wait for."""

    wait_for: tuple[str, ...] = parameter(
        (),
        f"streams that frames wait for from the start: {', '.join(STREAMS)}; what is heard later is waited for as well",
    )
    patience: int = parameter(
        PATIENCE, "frames that may wait for a stream before they go on without it", unit="frames", minimum=1
    )
    cameras: tuple[str, ...] = parameter(
        (),
        "names of the cameras of a rig that has several, each with its own topics below its name (``front/features``); "
        "empty: one camera",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        RigGroups(self.cameras)  # ValueError for names that cannot be
        if self.cameras and self.association.method in ("jcbb", "ccda"):
            raise ValueError(
                f"association.method '{self.association.method}' is for one camera, and the rig has "
                f"{len(self.cameras)}: take mahalanobis"
            )
        if unknown := set(self.wait_for) - set(STREAMS):
            known = ", ".join(STREAMS)
            raise ValueError(f"parameter 'wait_for' may hold {known}, got {', '.join(sorted(unknown))}")


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Estimate after one frame, and the number of its features."""

    estimate: EkfResult
    features: int


class FilterStage:
    """Feeds one rig's filter in the order of the stamps.

    Parameters
    ----------
    frames
        Knows where the camera and the IMU sit on the rig.
    session
        Number of the first session; -1: the second of the first frame's stamp, which no run before had.
    """

    def __init__(
        self, config: FilterConfig, frames: FrameTree, base_frame: str = "base_link", session: int = 0
    ) -> None:
        self._config = config
        self._frames = frames
        self._base_frame = base_frame
        self._waiting: deque[Features] = deque()
        self._motions: deque[RelativeMotion] = deque()
        self._samples: deque[ImuSample] = deque()
        self._last_sample_ns = -1
        self._poses: deque[OdometryReading] = deque()
        self._last_pose_ns = -1
        self._pressures: deque[PressureReading] = deque()
        self._awaited = AwaitedStreams(config.wait_for, config.patience)
        self._rig = RigGroups[Features](config.cameras, config.patience) if config.cameras else None
        self._slam: EkfSlam | None = None
        self._late = 0
        self._next_session = session

    @property
    def counters(self) -> Counters:
        """Counts of what the filter accepted and rejected."""
        return Counters() if self._slam is None else self._slam.counters

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another stream or camera."""
        if self._waiting:
            return self._waiting[0].stamp_ns
        return None if self._rig is None else self._rig.oldest_waiting_ns

    def add_features(self, features: Features, camera: str = "") -> None:
        """Take one frame; of a rig with several cameras that of ``camera``, which may have to wait for the others'.

        What comes too late is counted.

        Raises
        ------
        ValueError
            If the rig has no such camera.
        """
        if self._rig is None:
            self._take(features)
            return
        self._late += not self._rig.add(camera, features)
        self._take_frames_of_rig()

    def _take(self, features: Features) -> None:
        self._waiting.append(features)
        self._awaited.frame(features.stamp_ns)

    def _take_frames_of_rig(self) -> None:
        for parts in () if self._rig is None else self._rig.ready():
            self._take(features_of_rig(parts))

    def add_motion(self, stamp_ns: int, motion: RelativeMotion | None) -> None:
        """Take a motion of the rig that ended at a stamp, or word that it is not known."""
        if motion is not None:
            self._motions.append(motion)
        self._awaited.heard(MOTION, stamp_ns)

    def add_imu(self, sample: ImuSample) -> None:
        """Take an IMU's reading; ValueError if it is not known where the IMU sits."""
        T_base_imu = self._frames.lookup(self._base_frame, sample.frame_id)
        seen = sample.seen_from(T_base_imu, self._base_frame, round(self._config.imu.time_offset * 1e9))
        self._samples.append(seen)
        self._awaited.heard(IMU, seen.stamp_ns)

    def add_odometry(self, reading: OdometryReading) -> None:
        """Take a pose of an external odometry; ValueError if it is not known where on the rig its frame sits."""
        if self._config.odometry.use == "off":
            return
        mounting = self._frames.lookup(self._base_frame, reading.frame_id)
        self._poses.append(replace(reading, T_rig_frame=mounting))
        self._awaited.heard(ODOMETRY, reading.stamp_ns)

    def add_pressure(self, reading: PressureReading) -> None:
        """Take a pressure of the air; it measures the heights of lift rides."""
        if self._config.ride.use == "off":
            return
        self._pressures.append(reading)

    def ready(self) -> Iterator[FrameResult]:
        """Results of the frames that need not wait, oldest first.

        Raises
        ------
        ValueError
            If the mounting of the camera is not known, or a frame is unusable; the frames after it are kept.
        """
        while self._waiting and not self._awaited.must_wait(self._waiting[0].stamp_ns):
            yield self._process(self._waiting.popleft())

    @property
    def readout_s(self) -> tuple[float, float]:
        """Time from a picture's first row to its last and its standard deviation, s; zeros where nothing is known."""
        return (0.0, 0.0) if self._slam is None else self._slam.readout_s

    @property
    def readout_seen_s(self) -> tuple[float, float]:
        """That time as the frames alone show it, certain or not, and its standard error, s; zeros for too few."""
        return (0.0, 0.0) if self._slam is None else self._slam.readout_seen_s

    @property
    def diagnostic(self) -> str:
        """Findings about camera and odometry that a user should know of, or ""."""
        found = [self.shutter_finding, self.clock_finding, self.odometry_finding, self.rides_finding]
        return "; ".join(filter(None, found))

    @property
    def shutter_finding(self) -> str:
        """Finding about the time in which the camera reads a picture out, or ""."""
        readout, sigma = (1e3 * s for s in self.readout_s)
        rows = "first row to the last" if readout > 0.0 else "last row to the first"
        return f"rolling shutter: {abs(readout):.1f} +- {sigma:.1f} ms from the {rows}, corrected" if readout else ""

    @property
    def imu_time_offset_s(self) -> tuple[float, float]:
        """Time to be added to the IMU's stamps and its standard deviation, s; zeros where the parameter is right."""
        beyond, sigma = (0.0, 0.0) if self._slam is None else self._slam.imu_time_offset_s
        if abs(beyond) < max(_SIGNIFICANT_SIGMAS * sigma, _SIGNIFICANT_OFFSET_S):
            return 0.0, 0.0
        return self._config.imu.time_offset + beyond, sigma

    @property
    def clock_finding(self) -> str:
        """Finding about the IMU's clock, or ""."""
        offset, sigma = (1e3 * s for s in self.imu_time_offset_s)
        return f"IMU: its stamps are {-offset:+.1f} +- {sigma:.1f} ms off, corrected" if sigma else ""

    @property
    def odometry_finding(self) -> str:
        """The calibration of an external odometry as it was learnt, or ""."""
        return "" if self._slam is None else self._slam.odometry_finding

    @property
    def rides_finding(self) -> str:
        """The heights of lift rides, or ""."""
        return "" if self._slam is None else self._slam.rides_finding

    @property
    def ride_spans(self) -> tuple[tuple[int, int], ...]:
        """First and last stamp (ns) of each lift ride of this session."""
        return () if self._slam is None else tuple(self._slam.ride_spans)

    @property
    def moving_objects(self) -> str:
        """In how many frames objects moved, whose features were left out, or ""."""
        counts = self.counters.counts
        frames, features = (counts.get(f"{what}_{MOVING}", 0) for what in ("frames_with", "features_on"))
        return f"moving objects in {frames} frames: {features} features on them were left out" if frames else ""

    def landmark_view(self) -> LandmarkView:
        """The landmarks of the open submap after the newest result, of which there must be one."""
        assert self._slam is not None
        return self._slam.landmark_view()

    def give_up(self) -> None:
        """Stop waiting for what a live node has not heard for long, until it is heard again."""
        if self._rig is not None:
            self._rig.give_up()
            self._take_frames_of_rig()
        if self._waiting:
            self._awaited.give_up(self._waiting[-1].stamp_ns)

    def finish(self) -> tuple[Submap, ...]:
        """Close the open submap, after the last results were taken from :meth:`ready`."""
        return () if self._slam is None else self._slam.finish()

    def reset(self) -> None:
        """Forget everything; the mounting is looked up anew."""
        if self._slam is not None:
            self._next_session = self._slam.session + 1
        self._slam = None
        self._forget_queues()

    def start_session(self) -> tuple[Submap, ...]:
        """Close the open submap and begin anew with the next frame, whatever its stamp."""
        self._forget_queues()
        return () if self._slam is None else self._slam.start_session()

    def restart_camera(self, camera: str) -> None:
        """Forget what waits of a camera whose clock has jumped back, after that of the rig; ValueError for no such."""
        if self._rig is not None:
            self._rig.restart(camera)

    def _forget_queues(self) -> None:
        self._waiting.clear()
        self._motions.clear()
        self._samples.clear()
        self._poses.clear()
        self._pressures.clear()
        self._last_sample_ns = self._last_pose_ns = -1
        self._awaited.clear()
        if self._rig is not None:
            self._rig.clear()

    def _process(self, features: Features) -> FrameResult:
        """One frame, after all that was measured up to its stamp."""
        slam = self._filter(features)
        self._give_aids(slam, features.stamp_ns)
        result = slam.process(features)
        if self._late:
            slam.counters.add("features_of_a_camera_too_late", self._late)
            self._late = 0
        self._awaited.set_time_offset(IMU, self._offset_ns(slam))
        silent = "" if self._rig is None else self._rig.diagnostic
        if result.state is TrackingState.OK and (diagnostic := silent or self._awaited.diagnostic() or slam.diagnostic):
            result = replace(result, state=TrackingState.DEGRADED, reason=diagnostic)
        return FrameResult(result, len(features))

    def _filter(self, features: Features) -> EkfSlam:
        """The filter; a camera's mounting is looked up at its first frame."""
        if self._slam is None:
            session = self._next_session if self._next_session >= 0 else features.stamp_ns // 1_000_000_000
            T_base_optical = self._frames.lookup(self._base_frame, features.frame_id)
            self._slam = EkfSlam(self._config, T_base_optical, session)
        for camera in features.cameras:
            self._slam.mount(camera.frame_id, self._frames.lookup(self._base_frame, camera.frame_id))
        return self._slam

    @staticmethod
    def _offset_ns(slam: EkfSlam) -> int:
        """Time to be added to stamps of the IMU that are waited for; a small one is bridged by the last reading."""
        offset = slam.imu_time_offset_s[0]
        return round(1e9 * offset) if abs(offset) >= _SIGNIFICANT_OFFSET_S else 0

    def _give_aids(self, slam: EkfSlam, stamp_ns: int) -> None:
        """The motions that began before the frame, and readings up to the first that is not older.

        What has come beyond that depends on the speed of the replay.
        """
        while self._motions and self._motions[0].start_stamp_ns < stamp_ns:
            slam.process_motion(self._motions.popleft())
        offset_ns = self._offset_ns(slam)
        while self._samples and self._last_sample_ns + offset_ns < stamp_ns:
            sample = self._samples.popleft()
            self._last_sample_ns = sample.stamp_ns
            slam.process_imu(sample)
        while self._poses and self._last_pose_ns < stamp_ns:
            pose = self._poses.popleft()
            self._last_pose_ns = pose.stamp_ns
            slam.process_odometry(pose)
        while self._pressures and self._pressures[0].stamp_ns <= stamp_ns:
            slam.process_pressure(self._pressures.popleft())
