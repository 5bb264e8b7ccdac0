# SPDX-License-Identifier: Apache-2.0
"""Scan odometry without ROS: scans of one sensor, and readings of an IMU, in; the rig's poses and motions out."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ndt_registration.odometry import OdometryConfig, OdometryResult, OdometryStatus, ScanOdometry
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray, transform_points
from slam_core.motion import motion_of_rig, pose_of_rig
from slam_core.nodes.awaited_streams import AwaitedStreams
from slam_core.nodes.rig_groups import RigGroups
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
    cameras
        Names of the depth cameras of a rig that has several: what they measure at one moment is one scan, in the rig's
        own frame.
    """

    def __init__(
        self, config: OdometryConfig, frames: FrameTree, base_frame: str = "base_link", cameras: Sequence[str] = ()
    ) -> None:
        self.counters = Counters()
        self._config = config
        self._frames = frames
        self._base_frame = base_frame
        self._odometry = ScanOdometry(config)
        self._scans: deque[Scan] = deque()
        self._samples: deque[ImuSample] = deque(maxlen=_SAMPLES_KEPT)
        self._awaited = AwaitedStreams()
        self._rig = RigGroups[Scan](cameras) if cameras else None

    @property
    def diagnostic(self) -> str:
        """Since when the IMU or a camera is silent, or ""."""
        return self._awaited.diagnostic() or ("" if self._rig is None else self._rig.diagnostic)

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for another stream or camera."""
        if self._scans:
            return self._scans[0].stamp_ns
        return None if self._rig is None else self._rig.oldest_waiting_ns

    def add_scan(self, scan: Scan, camera: str = "") -> None:
        """Take a scan; of a rig with several cameras that of ``camera``, which may have to wait for the others'.

        What comes too late is counted.

        Raises
        ------
        ValueError
            If the rig has no such camera, or it is not known where it sits.
        """
        if self._rig is None:
            self._take(scan)
            return
        T_base_sensor = self._frames.lookup(self._base_frame, scan.frame_id)
        points = scan.points.reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        if not self._rig.add(camera, Scan(scan.stamp_ns, transform_points(T_base_sensor, points), self._base_frame)):
            self.counters.add("scans_of_a_camera_too_late")
        self._take_scans_of_rig()

    def _take(self, scan: Scan) -> None:
        self._scans.append(scan)
        self._awaited.frame(scan.stamp_ns)

    def _take_scans_of_rig(self) -> None:
        for parts in () if self._rig is None else self._rig.ready():
            points = np.concatenate([own.points for _, own in parts])
            self._take(Scan(parts[0][1].stamp_ns, points, self._base_frame))

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
        """Stop waiting for an IMU or a camera that a live node has not heard for long."""
        if self._rig is not None:
            self._rig.give_up()
            self._take_scans_of_rig()
        if self._scans:
            self._awaited.give_up(self._scans[-1].stamp_ns)

    def finish(self) -> None:
        """The input has ended: nothing waits any more."""
        self.give_up()

    def restart_camera(self, camera: str) -> None:
        """Forget what waits of a camera whose clock has jumped back, after that of the rig; ValueError for no such."""
        if self._rig is not None:
            self._rig.restart(camera)

    def reset(self) -> None:
        """Forget everything: the next scan is the origin."""
        self._odometry.reset()
        self._scans.clear()
        self._samples.clear()
        self._awaited.clear()
        if self._rig is not None:
            self._rig.clear()

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
