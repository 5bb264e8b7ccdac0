# SPDX-License-Identifier: Apache-2.0
"""Conversions between the data types of ``slam_core`` and ROS messages, written once and without ROS.

Messages are read by attribute (duck typing) and made through a :class:`MessageTypes`, so that the same code serves the
messages of rclpy (``slam_core.ros.RosTypes``) and those of a bag read by rosbags
(``slam_bags.storage.bag_types.BagTypes``).
``x_message(types, ...)`` makes a message, ``x_from_message(message)`` reads one. A message that contradicts
itself raises ``ValueError`` naming what is wrong.
"""

from slam_core.messages.base import MessageTypes, header_message, ns_from_time, stamp_ns, time_message
from slam_core.messages.cameras import camera_info_from_message, camera_info_message, rectified_info
from slam_core.messages.clouds import (
    cloud_from_message,
    cloud_message,
    landmark_cloud,
    points_from_message,
    points_from_scan,
    points_message,
)
from slam_core.messages.depth import DEPTH_TOPICS, DepthMessages, depth_from_messages, depth_messages
from slam_core.messages.features import FEATURE_TOPICS, FeatureMessages, features_from_messages, features_messages
from slam_core.messages.grids import occupancy_from_message, occupancy_message
from slam_core.messages.images import (
    colour_from_message,
    compressed_image_message,
    grey_and_colour_from_message,
    grey_from_message,
    image_from_message,
    image_message,
    mask_from_message,
    metres_from_message,
    picture_from_message,
)
from slam_core.messages.markers import ellipsoid_markers, path_marker
from slam_core.messages.poses import (
    STATIC_TRANSFORMS_TOPIC,
    estimate_from_message,
    imu_from_message,
    imu_message,
    motion_as_received,
    motion_from_message,
    motion_message,
    odometry_from_message,
    odometry_message,
    path_from_message,
    path_message,
    pose7_from_message,
    pose7_message,
    pose_from_message,
    pose_message,
    pose_stamped_message,
    pose_with_covariance_message,
    position_from_message,
    position_message,
    pressure_from_message,
    pressure_message,
    transform_from_message,
    transform_message,
)
from slam_core.messages.submaps import SUBMAP_TOPICS, SubmapMessages, rounded, submap_from_messages, submap_messages

__all__ = [
    "DEPTH_TOPICS",
    "FEATURE_TOPICS",
    "STATIC_TRANSFORMS_TOPIC",
    "SUBMAP_TOPICS",
    "DepthMessages",
    "FeatureMessages",
    "MessageTypes",
    "SubmapMessages",
    "camera_info_from_message",
    "camera_info_message",
    "cloud_from_message",
    "cloud_message",
    "colour_from_message",
    "compressed_image_message",
    "depth_from_messages",
    "depth_messages",
    "ellipsoid_markers",
    "estimate_from_message",
    "features_from_messages",
    "features_messages",
    "grey_and_colour_from_message",
    "grey_from_message",
    "header_message",
    "image_from_message",
    "image_message",
    "imu_from_message",
    "imu_message",
    "landmark_cloud",
    "mask_from_message",
    "metres_from_message",
    "motion_as_received",
    "motion_from_message",
    "motion_message",
    "ns_from_time",
    "occupancy_from_message",
    "occupancy_message",
    "odometry_from_message",
    "odometry_message",
    "path_from_message",
    "path_marker",
    "path_message",
    "picture_from_message",
    "points_from_message",
    "points_from_scan",
    "points_message",
    "pose7_from_message",
    "pose7_message",
    "pose_from_message",
    "pose_message",
    "pose_stamped_message",
    "pose_with_covariance_message",
    "position_from_message",
    "position_message",
    "pressure_from_message",
    "pressure_message",
    "rectified_info",
    "rounded",
    "stamp_ns",
    "submap_from_messages",
    "submap_messages",
    "time_message",
    "transform_from_message",
    "transform_message",
]
