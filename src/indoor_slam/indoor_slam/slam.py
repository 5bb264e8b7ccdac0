# SPDX-License-Identifier: Apache-2.0
"""One rig: images of its camera and readings of its IMU in, results of the filter and a joined map out.

The stages are those of the nodes and of ``slam run``; joining runs on a thread of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

import numpy as np

from ekf_slam_node.results import EkfResult
from ekf_slam_node.stage import FilterStage
from sjsam_node.session.map_session import MapSession, Outcome
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_bags.reading.readings import AgentSensors, DepthReading, ImuReading, Reading, StereoReading
from slam_bringup.pipeline.configuration import SystemConfig, choose, filter_config, system_config
from slam_bringup.pipeline.mapper import add_to_filter
from slam_bringup.pipeline.overrides import overrides_of
from slam_bringup.pipeline.sensor_pipeline import SensorPipeline
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.camera import CameraInfo
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray, make_transform
from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.types import AnyArray, ByteArray, ImuSample, Submap
from stereo_frontend.sources import RawPair
from tof_driver.stage import RawDepth

_LOG = logging.getLogger(__name__)
_BASE, _IMU = "base_link", "imu"
_LEFT, _TOF = "stereo_left_optical_frame", "tof_optical_frame"
_OPTICAL = make_transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""T_base_camera of a camera that looks ahead (REP-103): x ahead, y left, z up from z ahead, x right, y down."""


class _Slam:
    """SLAM of one rig, whatever its camera."""

    def __init__(self, config: SystemConfig, sensors: AgentSensors, odometry: str) -> None:
        use_one_blas_thread()
        self._pipeline = SensorPipeline(config, sensors, odometry != "none", StageTimes())
        self._filter = FilterStage(filter_config(config.ekf_slam, sensors), sensors.frames, _BASE)
        self._session = MapSession(config.sjsam)
        self._has_imu = "imu" in sensors.topics
        self._newest_ns: dict[type[Reading], int] = {}
        self._futures: list[Future[Outcome | None]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread that joins submaps."""
        self._session.__exit__()

    @property
    def map(self) -> MapSnapshot:
        """The map as of the last submap that was joined; it stays as it is while the map goes on."""
        return self._session.snapshot

    def add_imu(self, stamp_ns: int, angular_velocity: FloatArray, linear_acceleration: FloatArray) -> list[EkfResult]:
        """Results that a reading of the IMU completes, as those of the images.

        Parameters
        ----------
        stamp_ns
            Nanoseconds, of the same clock as the images'.
        angular_velocity, linear_acceleration
            (3,) rad/s and m/s2 with gravity, along the IMU's axes.

        Raises
        ------
        ValueError
            If the rig was made without an IMU, or the stamp is not later than the last one.
        """
        if not self._has_imu:
            raise ValueError("this rig has no IMU: give its T_base_imu (4, 4) where the rig is made")
        sample = ImuSample(stamp_ns, np.asarray(angular_velocity), np.asarray(linear_acceleration), _IMU)
        return self._add(ImuReading("", sample))

    def finish(self) -> MapSnapshot:
        """The map of everything that was added: the open submap is closed, all are joined, closures judged again.

        A submap that could not be joined is left out; a warning of :mod:`logging` says so.
        """
        for item in self._pipeline.finish():
            add_to_filter(self._filter, self._pipeline.measure(item).value)
        self._filter.give_up()
        self._results()
        self._join(self._filter.start_session())
        self._session.finish().result()
        for error in filter(None, (future.exception() for future in self._futures)):
            _LOG.warning("a submap could not be joined and is left out of the map: %r", error)
        self._futures.clear()
        return self._session.read(lambda now: now).result()

    def save(self, folder: Path | str) -> None:
        """Write the map into a folder that ``GlobalMap.load`` and ``slam run --map`` read."""
        self._session.save(Path(folder)).result()

    def _add(self, reading: Reading) -> list[EkfResult]:
        last = self._newest_ns.get(type(reading))
        if last is not None and reading.stamp_ns <= last:
            raise ValueError(f"stamp {reading.stamp_ns} is not later than the last one, {last}")
        self._newest_ns[type(reading)] = reading.stamp_ns
        for item in self._pipeline.add(reading):
            add_to_filter(self._filter, self._pipeline.measure(item).value)
        return self._results()

    def _results(self) -> list[EkfResult]:
        found = [frame.estimate for frame in self._filter.ready()]
        self._join(submap for estimate in found for submap in estimate.submaps)
        return found

    def _join(self, submaps: Iterable[Submap]) -> None:
        self._futures += [self._session.add(submap) for submap in submaps]


class StereoSlam(_Slam):
    """SLAM with a stereo camera.

    Parameters
    ----------
    left, right
        Calibrations of the two cameras, as ``sensor_msgs/CameraInfo`` has them.
    T_base_left
        Pose of the left camera's optical frame on the rig, (4, 4); by default it looks ahead from the rig's origin.
    T_base_imu
        Pose of the IMU's frame on the rig, (4, 4), where there is one.
    parameters
        Values by node and parameter as in ``docs/parameters.md``, ``{"ekf_slam": {"submap.max_distance": 1.5}}``.

    Raises
    ------
    ValueError
        If a calibration, transform or parameter is wrong; the message says which.
    """

    def __init__(
        self,
        left: CameraInfo,
        right: CameraInfo,
        *,
        T_base_left: FloatArray = _OPTICAL,
        T_base_imu: FloatArray | None = None,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        frames = _frames({_LEFT: T_base_left}, T_base_imu)
        topics = _topics(("left", "right"), T_base_imu)
        sensors = AgentSensors("", left, right, None, "range", frames, left_frame=_LEFT, topics=topics)
        super().__init__(_config("stereo", "none", parameters), sensors, "none")

    def add_pair(self, stamp_ns: int, left: ByteArray, right: ByteArray) -> list[EkfResult]:
        """Results of the frames that are complete with this pair, oldest first; with an IMU a frame waits for it.

        Parameters
        ----------
        stamp_ns
            Nanoseconds, later than those of the pair before.
        left, right
            Raw grey images (height, width) uint8.

        Raises
        ------
        ValueError
            If an image does not fit its calibration, or the stamp is not later than the last one.
        """
        return self._add(StereoReading("", RawPair(stamp_ns, left, right, _LEFT)))


class DepthSlam(_Slam):
    """SLAM with a ToF or other depth camera.

    Parameters
    ----------
    info
        Calibration of the camera, as ``sensor_msgs/CameraInfo`` has it.
    measurement
        "depth" along the optical axis, or "range" along the ray.
    odometry
        Registration of its scans beside the features: "none", "ndt" or "icp".
    T_base_camera
        Pose of its optical frame on the rig, (4, 4); by default it looks ahead from the rig's origin.
    T_base_imu, parameters
        As those of :class:`StereoSlam`.
    """

    def __init__(
        self,
        info: CameraInfo,
        *,
        measurement: str = "depth",
        odometry: str = "none",
        T_base_camera: FloatArray = _OPTICAL,
        T_base_imu: FloatArray | None = None,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        if measurement not in ("depth", "range"):
            raise ValueError(f"measurement must be depth or range, got {measurement!r}")
        frames = _frames({_TOF: T_base_camera}, T_base_imu)
        topics = _topics(("depth",), T_base_imu)
        sensors = AgentSensors("", None, None, info, measurement, frames, tof_frame=_TOF, topics=topics)
        super().__init__(_config("tof", odometry, parameters), sensors, odometry)

    def add_image(self, stamp_ns: int, depth: AnyArray, picture: ByteArray | None = None) -> list[EkfResult]:
        """Results of the frames that are complete with this image, oldest first.

        Parameters
        ----------
        stamp_ns
            Nanoseconds, later than those of the image before.
        depth
            (height, width), uint16 mm or float m; 0 or NaN where nothing was measured.
        picture
            Amplitude or grey picture of the same pixels, uint8 or uint16, in which features are found; without it they
            are found in the depth image.

        Raises
        ------
        ValueError
            If the image does not fit the calibration, or the stamp is not later than the last one.
        """
        return self._add(DepthReading("", RawDepth(stamp_ns, depth, picture, None, _TOF)))


def _frames(cameras: Mapping[str, FloatArray], T_base_imu: FloatArray | None) -> FrameTree:
    tree = FrameTree()
    for name, T in (cameras if T_base_imu is None else {**cameras, _IMU: T_base_imu}).items():
        tree.add(_BASE, name, np.asarray(T, dtype=np.float64))
    return tree


def _topics(roles: tuple[str, ...], T_base_imu: FloatArray | None) -> dict[str, str]:
    """Roles of the sensors that there are; a library has no names of topics."""
    return dict.fromkeys(roles if T_base_imu is None else (*roles, "imu"), "")


def _config(mode: str, odometry: str, parameters: Mapping[str, Mapping[str, Any]] | None) -> SystemConfig:
    return choose(system_config(overrides_of(dict(parameters or {}), "parameters")), mode, "sjsam", odometry)
