# SPDX-License-Identifier: Apache-2.0
"""Transforms for a recording without /tf or /tf_static, from topics that carry the same: every viewer needs them."""

from __future__ import annotations

from slam_bags.storage.bag_types import BagTypes
from slam_core.messages import pose_from_message, stamp_ns, transform_from_message, transform_message
from slam_core.messages.base import Message

_TYPES = BagTypes()
_CARRIERS = {"map_to_odom": "/tf", "static_transforms": "/tf_static", "odom": "/tf"}


def transform_topic(topic: str) -> str | None:
    """Topic for the transforms carried by ``topic``, /tf or /tf_static; None if it carries none."""
    return _CARRIERS.get(topic.rsplit("/", 1)[-1])


def transforms_of(message: Message) -> Message:
    """tf2_msgs/TFMessage of a TransformStamped, or of an Odometry's pose."""
    if hasattr(message, "transform"):
        parent, child, T = transform_from_message(message)
    else:
        parent, child, T = message.header.frame_id, message.child_frame_id, pose_from_message(message.pose.pose)
    return _TYPES.TFMessage(transforms=[transform_message(_TYPES, stamp_ns(message), parent, child, T)])
