# SPDX-License-Identifier: Apache-2.0
"""The chain as a library: NumPy arrays in, poses with covariances and maps out. No ROS is needed.

Docs, with an example: docs/library.md.
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
