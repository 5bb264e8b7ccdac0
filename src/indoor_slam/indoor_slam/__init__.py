# SPDX-License-Identifier: Apache-2.0
"""The chain as a library: NumPy arrays in, poses with covariances and maps out. No ROS is needed.

from indoor_slam import CameraInfo, StereoSlam

with StereoSlam(left_info, right_info) as slam:
for stamp_ns, left, right in pairs:
for frame in slam.add_pair(stamp_ns, left, right):
print(frame.stamp_ns, frame.state, frame.pose.T, frame.pose.covariance)
joined = slam.finish()
"""

from indoor_slam.slam import DepthSlam, StereoSlam
from ndt_registration.registration import RegistrationConfig, RegistrationResult, register
from sjsam_node.global_map import GlobalMap
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.camera import Camera, CameraInfo

__all__ = [
    "Camera",
    "CameraInfo",
    "DepthSlam",
    "GlobalMap",
    "MapSnapshot",
    "RegistrationConfig",
    "RegistrationResult",
    "StereoSlam",
    "register",
]
