# SPDX-License-Identifier: Apache-2.0
"""Construction of messages, whatever library they belong to, and their stamps and headers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from slam_core.types import AnyArray

MESSAGE_PACKAGES = {
    "builtin_interfaces": ("Time", "Duration"),
    "std_msgs": ("Header", "ColorRGBA", "Int32"),
    "geometry_msgs": (
        "Point", "Vector3", "Quaternion", "Pose", "Transform", "Twist", "PoseStamped", "PointStamped",
        "TransformStamped", "PoseWithCovariance", "PoseWithCovarianceStamped", "TwistWithCovariance",
    ),
    "sensor_msgs": (
        "Image", "CompressedImage", "CameraInfo", "PointCloud2", "PointField", "LaserScan", "Imu", "FluidPressure",
    ),
    "nav_msgs": ("Odometry", "Path", "OccupancyGrid", "MapMetaData"),
    "visualization_msgs": ("Marker", "MarkerArray"),
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    "rosgraph_msgs": ("Clock",),
    "tf2_msgs": ("TFMessage",),
}  # fmt: skip
"""Every message type in use, by package."""

_PACKAGE_OF = {name: package for package, names in MESSAGE_PACKAGES.items() for name in names}

Message = Any


class MessageTypes(ABC):
    """Makes messages by name: ``types.Image(height=480, ...)``; fields that are not given keep the type's default."""

    def __getattr__(self, name: str) -> Any:
        if name not in _PACKAGE_OF:
            raise AttributeError(f"{name} is not a message type in use")
        constructor = self.load(_PACKAGE_OF[name], name)
        setattr(self, name, constructor)
        return constructor

    @abstractmethod
    def load(self, package: str, name: str) -> Any:
        """Factory of messages of one type: a callable that takes the fields by keyword."""

    @abstractmethod
    def octets(self, array: AnyArray) -> Any:
        """The bytes of an array as the library wants them in a ``uint8[]`` field."""

    @abstractmethod
    def signed_octets(self, array: AnyArray) -> Any:
        """An int8 array as the library wants it in an ``int8[]`` field."""


def ns_from_time(time: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time or Duration."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def stamp_ns(message: Message) -> int:
    """Header stamp of a message, integer nanoseconds."""
    return ns_from_time(message.header.stamp)


def time_message(types: MessageTypes, stamp: int) -> Message:
    """builtin_interfaces/Time of integer nanoseconds."""
    return types.Time(sec=int(stamp // 1_000_000_000), nanosec=int(stamp % 1_000_000_000))


def header_message(types: MessageTypes, stamp: int, frame_id: str) -> Message:
    """std_msgs/Header of a stamp (ns) and a frame."""
    return types.Header(stamp=time_message(types, stamp), frame_id=frame_id)
