# SPDX-License-Identifier: Apache-2.0
"""The ``view/*`` topics of a dense key frame that came over the radio: depth, colours, and where the camera was.

``view/depth/image``, ``view/noise/image``, ``view/camera_info`` are as those of ``tof``. ``view/color/image`` is rgb8
of the same size. ``view/anchor`` is a Path of one pose: that of the camera in the frame of the rig at the pose's own
stamp, at which a submap starts; the map's path has that stamp, and moves with the map.
"""

from __future__ import annotations

from typing import NamedTuple

from slam_core.geometry import FloatArray
from slam_core.messages.base import Message, MessageTypes, header_message
from slam_core.messages.cameras import camera_info_message, rectified_info
from slam_core.messages.depth import depth_from_messages
from slam_core.messages.images import colour_from_message, image_message
from slam_core.messages.poses import path_from_message, pose_stamped_message
from slam_core.types import ByteArray, DepthImage

KEY_FRAME_TOPICS = {
    "view/depth/image": "Image",
    "view/noise/image": "Image",
    "view/camera_info": "CameraInfo",
    "view/color/image": "Image",
    "view/anchor": "Path",
}
"""Topic and type of each message of a key frame, in the order of :func:`key_frame_messages`."""


class AnchoredKeyFrame(NamedTuple):
    """A depth image, its colours (height, width, 3) uint8, and the camera's pose in the rig of ``start_stamp_ns``."""

    image: DepthImage
    colours: ByteArray
    start_stamp_ns: int
    T_start_camera: FloatArray


def key_frame_messages(types: MessageTypes, frame: AnchoredKeyFrame) -> tuple[Message, ...]:
    """Messages of the topics of :data:`KEY_FRAME_TOPICS`."""
    image = frame.image
    header = header_message(types, image.stamp_ns, image.frame_id)
    anchor = pose_stamped_message(types, frame.start_stamp_ns, image.frame_id, frame.T_start_camera)
    return (
        image_message(types, header, image.depth),
        image_message(types, header, image.sigma),
        camera_info_message(types, header, rectified_info(image.camera)),
        image_message(types, header, frame.colours, "rgb8"),
        types.Path(header=header, poses=[anchor]),
    )


def key_frame_from_messages(*messages: Message) -> AnchoredKeyFrame:
    """Inverse of :func:`key_frame_messages`; ValueError if a size does not fit or there is not one pose."""
    depth, noise, info, colours, anchor = messages
    image, poses = depth_from_messages(depth, noise, info), path_from_message(anchor)
    picture = colour_from_message(colours)
    if len(poses) != 1 or picture.shape[:2] != image.depth.shape:
        raise ValueError(f"a key frame has one pose and colours of its size, got {len(poses)} and {picture.shape}")
    return AnchoredKeyFrame(image, picture, *poses[0])
