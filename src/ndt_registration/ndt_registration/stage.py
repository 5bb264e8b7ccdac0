# SPDX-License-Identifier: Apache-2.0
"""Scan odometry without ROS: scans of one sensor, and readings of an IMU, in; the rig's poses and motions out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ndt_registration.odometry import OdometryConfig, OdometryResult, OdometryStatus, ScanOdometry
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray
from slam_core.motion import motion_of_rig, pose_of_rig
from slam_core.nodes.awaited_streams import AwaitedStreams
from slam_core.types import AnyArray, Counters, ImuSample, PoseEstimate, RelativeMotion

IMU = "imu"
_SAMPLES_KEPT = 10_000
"""IMU readings kept while no scan comes."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (..., 3) m of one instant in the sensor's frame, NaN where there is none."""

    stamp_ns: int
    points: AnyArray
    frame_id: str = "tof_optical_frame"


@dataclass(frozen=True, eq=False)
class ScanEstimate:
    """Estimate from a scan: ``pose`` T_odom_base and ``motion`` since the scan before, None if not known.

    ``scan`` sat at ``T_odom_sensor``. ``result`` is the registration, in the sensor's own frame.
    """

    pose: PoseEstimate
    motion: RelativeMotion | None
    result: OdometryResult
    scan: Scan
    T_odom_sensor: FloatArray


class ScanOdometryStage:
    """Poses of scans, in the order of their stamps; each waits for the IMU where the odometry uses one.

    Parameters
    ----------
    frames
        Knows where the sensors sit on the rig.
    """

    def __init__(self, config: OdometryConfig, frames: FrameTree, base_frame: str = "base_link") -> None:
        self.counters = Counters()
        self._config = config
        self._frames = frames
        self._base_frame = base_frame
        self._odometry = ScanOdometry(config)
        self._scans: deque[Scan] = deque()
        self._samples: deque[ImuSample] = deque(maxlen=_SAMPLES_KEPT)
        self._awaited = AwaitedStreams()

    @property
    def diagnostic(self) -> str:
        """Since when the IMU is silent, or ""."""
        return self._awaited.diagnostic()

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another stream."""
        return self._scans[0].stamp_ns if self._scans else None

    def add_scan(self, scan: Scan) -> None:
        """Take a scan."""
        self._scans.append(scan)
        self._awaited.frame(scan.stamp_ns)

    def add_imu(self, sample: ImuSample) -> None:
        """Take an IMU's reading; without the parameter ``imu.enabled`` nothing comes of it."""
        if self._config.imu.enabled:
            stamp_ns = sample.stamp_ns + round(1e9 * self._config.imu.time_offset)
            self._samples.append(replace(sample, stamp_ns=stamp_ns))
            self._awaited.heard(IMU, stamp_ns)

    def ready(self) -> Iterator[ScanEstimate]:
        """Estimates of the scans that need not wait, oldest first.

        Raises
        ------
        ValueError
            If a mounting is not known or a scan is not newer than the last; the scans after it are kept.
        """
        while self._scans and not self._awaited.must_wait(self._scans[0].stamp_ns):
            yield self._register(self._scans.popleft())

    def give_up(self) -> None:
        """Stop waiting for an IMU that a live node has not heard for long."""
        if self._scans:
            self._awaited.give_up(self._scans[-1].stamp_ns)

    def finish(self) -> None:
        """The input has ended: nothing waits any more."""
        self.give_up()

    def reset(self) -> None:
        """Forget everything: the next scan is the origin."""
        self._odometry.reset()
        self._scans.clear()
        self._samples.clear()
        self._awaited.clear()

    def _register(self, scan: Scan) -> ScanEstimate:
        T_base_sensor = self._frames.lookup(self._base_frame, scan.frame_id)
        self._use_turn_rates(scan.frame_id)
        result = self._odometry.process(scan.stamp_ns, scan.points)
        self.counters.add(result.status.value.lower())
        if result.status is not OdometryStatus.FAILED and self.diagnostic:
            result = replace(result, reason=self.diagnostic)
        pose = pose_of_rig(PoseEstimate(result.stamp_ns, result.T, result.covariance), T_base_sensor)
        motion = None if result.motion is None else motion_of_rig(result.motion, T_base_sensor)
        return ScanEstimate(pose, motion, result, scan, pose.T @ T_base_sensor)

    def _use_turn_rates(self, frame_id: str) -> None:
        while self._samples:
            sample = self._samples.popleft()
            R_sensor_imu = self._frames.lookup(frame_id, sample.frame_id)[:3, :3]
            self._odometry.add_angular_velocity(sample.stamp_ns, R_sensor_imu @ sample.angular_velocity)
