# SPDX-License-Identifier: Apache-2.0
"""Camera calibrations: sensor_msgs/CameraInfo from and to :class:`slam_core.camera.CameraInfo`."""

from __future__ import annotations

import numpy as np

from slam_core.camera import Camera, CameraInfo
from slam_core.messages.base import Message, MessageTypes

MAX_PIXELS = 25_000_000
"""More than any camera of a rig has: rectification keeps several numbers for each."""

_MODEL_OF_MESSAGE = {"fisheye": "equidistant", "": "none"}


def camera_info_message(types: MessageTypes, header: Message, info: CameraInfo) -> Message:
    """sensor_msgs/CameraInfo; a camera without distortion becomes plumb_bob with five zeros, as ROS tools expect."""
    camera = info.camera
    plain = camera.distortion_model == "none"
    return types.CameraInfo(
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob" if plain else camera.distortion_model,
        d=[0.0] * 5 if plain else list(camera.distortion),
        k=camera.K.ravel(),
        r=info.R.ravel(),
        p=info.P.ravel(),
    )


def camera_info_from_message(message: Message) -> CameraInfo:
    """The calibration that a sensor_msgs/CameraInfo carries.

    Raises
    ------
    ValueError
        If the camera is not calibrated (focal length zero), a number is not finite, the distortion model unknown, or
        the image too large to be one.
    """
    if int(message.width) * int(message.height) > MAX_PIXELS:
        raise ValueError(f"camera info of {message.width} x {message.height} px: more than {MAX_PIXELS} pixels")
    K = np.asarray(message.k, dtype=np.float64).reshape(3, 3)
    P = np.asarray(message.p, dtype=np.float64).reshape(3, 4)
    fx, fy, cx, cy = _uncropped(message, K)
    model = _MODEL_OF_MESSAGE.get(message.distortion_model, message.distortion_model)
    distortion = tuple(float(v) for v in message.d)
    if not any(distortion):
        model, distortion = "none", ()
    camera = Camera(int(message.width), int(message.height), fx, fy, cx, cy, model, distortion)
    return CameraInfo(camera, np.asarray(message.r, dtype=np.float64).reshape(3, 3), P)


def rectified_info(camera: Camera, baseline: float = 0.0) -> CameraInfo:
    """Camera info of a rectified image; ``baseline`` (m) is positive for the right camera of a pair, else zero."""
    P = np.column_stack([camera.K, [-camera.fx * baseline, 0.0, 0.0]])
    return CameraInfo(camera, np.eye(3), P)


def _uncropped(message: Message, K: np.ndarray) -> tuple[float, float, float, float]:
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    if binning != (1, 1) or message.roi.width or message.roi.height:
        raise ValueError(f"camera info with binning {binning} or a region of interest is not supported")
    if K[0, 0] == 0.0 or K[1, 1] == 0.0:
        raise ValueError("camera info has focal length 0 px: the camera is not calibrated")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
