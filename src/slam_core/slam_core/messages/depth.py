# SPDX-License-Identifier: Apache-2.0
"""The ``tof/*`` topics that the ToF driver publishes: rectified depth, its standard deviation, pictures and points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam_core.messages.base import Message, MessageTypes, header_message, stamp_ns
from slam_core.messages.cameras import camera_info_from_message, camera_info_message, rectified_info
from slam_core.messages.clouds import points_message
from slam_core.messages.images import image_from_message, image_message
from slam_core.types import DepthImage, Float32Array


class DepthMessages(NamedTuple):
    """One depth image as messages; amplitude and intensity are None where the sensor has none."""

    depth: Message
    noise: Message
    camera_info: Message
    points: Message
    amplitude: Message | None
    intensity: Message | None


DEPTH_TOPICS = {
    "tof/depth/image": "Image",
    "tof/noise/image": "Image",
    "tof/camera_info": "CameraInfo",
    "tof/points": "PointCloud2",
    "tof/amplitude/image": "Image",
    "tof/intensity/image": "Image",
}
"""Topic and type of each field of :class:`DepthMessages`, in its order."""


def depth_messages(types: MessageTypes, image: DepthImage, points: Message | None = None) -> DepthMessages:
    """Messages that carry ``image`` exactly, with ``points``, or its own: organised, NaN where there is no depth."""
    header = header_message(types, image.stamp_ns, image.frame_id)
    points = points_message(types, header, image.points()) if points is None else points

    def picture(pixels: Float32Array | None) -> Message | None:
        return None if pixels is None else image_message(types, header, np.asarray(pixels, dtype="<f4"))

    return DepthMessages(
        picture(image.depth),
        picture(image.sigma),
        camera_info_message(types, header, rectified_info(image.camera)),
        points,
        picture(image.amplitude),
        picture(image.intensity),
    )


def depth_from_messages(
    depth: Message,
    noise: Message,
    camera_info: Message,
    amplitude: Message | None = None,
    intensity: Message | None = None,
) -> DepthImage:
    """Inverse of :func:`depth_messages`; ValueError if an image is not 32FC1 or not of the camera info's size."""
    camera = camera_info_from_message(camera_info).rectified

    def picture(name: str, message: Message) -> Float32Array:
        pixels = image_from_message(message)
        if pixels.dtype != np.float32 or pixels.shape != (camera.height, camera.width):
            size = f"{camera.width} x {camera.height} px"
            raise ValueError(f"{name} image must be 32FC1 of {size}, got {pixels.dtype} {pixels.shape[::-1]}")
        return pixels

    return DepthImage(
        stamp_ns(depth),
        picture("depth", depth),
        picture("noise", noise),
        camera,
        None if amplitude is None else picture("amplitude", amplitude),
        None if intensity is None else picture("intensity", intensity),
        depth.header.frame_id,
    )
