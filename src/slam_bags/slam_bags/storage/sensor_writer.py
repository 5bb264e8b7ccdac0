# SPDX-License-Identifier: Apache-2.0
"""Writes what a rig's sensors report to a bag, on the topics and frames of the nodes; counterpart of ``sensor_bag``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_bags.storage.bag import BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_core.camera import CameraInfo
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform
from slam_core.messages import (
    camera_info_message,
    header_message,
    image_message,
    imu_message,
    odometry_message,
    pose_stamped_message,
    position_message,
    pressure_message,
    transform_message,
)
from slam_core.types import (
    AnyArray,
    ByteArray,
    ImuSample,
    OdometryReading,
    PoseEstimate,
    PositionReading,
    PressureReading,
)

BASE_FRAME = "base_link"
LEFT_FRAME = "stereo_left_optical_frame"
RIGHT_FRAME = "stereo_right_optical_frame"
TOF_FRAME = "tof_optical_frame"
IMU_FRAME = "imu_link"
WORLD_FRAME = "world"

T_BASE_OPTICAL: FloatArray = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))
"""A camera at the rig's origin that looks forward."""


class SensorWriter:
    """Messages of one agent's sensors.

    Parameters
    ----------
    bag
        An open bag.
    agent
        Namespace of the agent, also the prefix of its frames; "" for a single rig.
    camera
        Namespace, below the agent's, of the images and their frames of one of several cameras; "" of one alone.
    """

    def __init__(self, bag: BagWriter, agent: str = "", camera: str = "") -> None:
        self._bag = bag
        self._types = BagTypes()
        self._prefix = f"/{agent}" if agent else ""
        self._camera_prefix = f"{self._prefix}/{camera}" if camera else self._prefix
        self._frame_prefix = f"{agent}/" if agent else ""
        self._camera_frame_prefix = f"{self._frame_prefix}{camera}/" if camera else self._frame_prefix

    def extrinsics(self, stamp_ns: int, T_base_frame: Mapping[str, FloatArray]) -> None:
        """Static transforms (4, 4) from base_link to frames by name, to be written before the first reading."""
        transforms = [
            transform_message(self._types, stamp_ns, self._frame(BASE_FRAME), self._frame(name), T)
            for name, T in T_base_frame.items()
        ]
        self._bag.write("/tf_static", self._types.TFMessage(transforms=transforms), stamp_ns)

    def stereo(self, stamp_ns: int, left: ByteArray, right: ByteArray, infos: tuple[CameraInfo, CameraInfo]) -> None:
        """A raw pair, uint8 (height, width) or (height, width, 3), red first, with the left and right camera info."""
        for side, frame, image, info in zip(
            ("left", "right"), (LEFT_FRAME, RIGHT_FRAME), (left, right), infos, strict=True
        ):
            self.picture(f"stereo/{side}/image_raw", stamp_ns, frame, image)
            self.info(f"stereo/{side}/camera_info", stamp_ns, frame, info)

    def depth(
        self, stamp_ns: int, image: AnyArray, info: CameraInfo, *, measurement: str, **pictures: AnyArray | None
    ) -> None:
        """A raw image of a depth camera.

        ``measurement`` "range" (along the ray) or "depth" (along z), uint16 mm or float32 m; further pictures by name
        (``amplitude``, ``intensity``, and ``color``, red first) where there are any.
        """
        self.picture(f"tof/{measurement}/image_raw", stamp_ns, TOF_FRAME, image)
        for name, picture in pictures.items():
            if picture is not None:
                self.picture(f"tof/{name}/image_raw", stamp_ns, TOF_FRAME, picture)
        self.info("tof/camera_info", stamp_ns, TOF_FRAME, info)

    def imu(self, sample: ImuSample) -> None:
        """An IMU reading in the axes of ``imu_link``."""
        message = imu_message(self._types, self._frame(IMU_FRAME), sample)
        self._bag.write(f"{self._prefix}/imu", message, sample.stamp_ns)

    def odometry(self, reading: OdometryReading) -> None:
        """A pose of the reading's own frame, in a frame ``wheel_odom``."""
        pose = PoseEstimate(reading.stamp_ns, reading.T, reading.covariance)
        twist = reading.twist, reading.twist_covariance
        frames = self._frame("wheel_odom"), self._frame(reading.frame_id)
        self._bag.write(f"{self._prefix}/odometry", odometry_message(self._types, *frames, pose, twist), pose.stamp_ns)

    def position(self, reading: PositionReading, frame: str) -> None:
        """A position of the rig's antenna in a fixed frame, which all agents share."""
        self._bag.write(f"{self._prefix}/position", position_message(self._types, frame, reading), reading.stamp_ns)

    def pressure(self, reading: PressureReading) -> None:
        """A pressure of the air at the rig."""
        message = pressure_message(self._types, self._frame(BASE_FRAME), reading)
        self._bag.write(f"{self._prefix}/pressure", message, reading.stamp_ns)

    def ground_truth(self, stamp_ns: int, T_world_base: FloatArray) -> None:
        """True pose of base_link."""
        message = pose_stamped_message(self._types, stamp_ns, WORLD_FRAME, T_world_base)
        self._bag.write(f"{self._prefix}/ground_truth/pose", message, stamp_ns)

    def picture(self, topic: str, stamp_ns: int, frame: str, image: AnyArray) -> None:
        """One image on a topic below the camera's namespace."""
        header = header_message(self._types, stamp_ns, self._frame(frame))
        message = image_message(self._types, header, image, "rgb8" if image.ndim == 3 else "")
        self._bag.write(f"{self._camera_prefix}/{topic}", message, stamp_ns)

    def info(self, topic: str, stamp_ns: int, frame: str, info: CameraInfo) -> None:
        """One camera info on a topic below the camera's namespace."""
        header = header_message(self._types, stamp_ns, self._frame(frame))
        self._bag.write(f"{self._camera_prefix}/{topic}", camera_info_message(self._types, header, info), stamp_ns)

    def _frame(self, name: str) -> str:
        of_camera = name in (LEFT_FRAME, RIGHT_FRAME, TOF_FRAME)
        return f"{self._camera_frame_prefix if of_camera else self._frame_prefix}{name}"
