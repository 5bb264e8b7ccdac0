# SPDX-License-Identifier: Apache-2.0
"""From a calibrated pair to the R and P of both camera infos: the rotation that makes rows epipolar lines.

Works for every lens model. Both rectified cameras get the same focal length and principal point, so that a point at
infinity has disparity zero, and the largest picture in which every pixel comes from inside both lenses.
"""

from __future__ import annotations

import numpy as np

from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import FloatArray

WIDEST_TANGENT = np.tan(np.radians(60.0))
"""A rectified picture reaches at most 60 degrees off its axis: beyond, a fisheye would be all stretched border."""


def stereo_infos(left: Camera, right: Camera, T_right_left: FloatArray) -> tuple[CameraInfo, CameraInfo]:
    """Camera infos of a pair.

    Parameters
    ----------
    left, right
        Raw cameras of equal image size.
    T_right_left
        From the left to the right optical frame, shape (4, 4), m.

    Raises
    ------
    ValueError
        If the right camera is not to the right of the left one, or the sizes differ.
    """
    if (left.width, left.height) != (right.width, right.height):
        raise ValueError(
            f"a stereo pair needs equal images, got {left.width} x {left.height} and {right.width} x {right.height} px"
        )
    R = T_right_left[:3, :3]
    position = -R.T @ T_right_left[:3, 3]
    if position[0] < np.abs(position[1:]).max():
        raise ValueError(
            f"the second camera is at {np.round(position, 4).tolist()} m in the first one's optical frame, not to its "
            "right: are left and right swapped?"
        )
    R_left = _row_aligned(position, R.T @ [0.0, 0.0, 1.0])
    R_right = R_left @ R.T
    P_left = _common_projection(left, R_left, right, R_right)
    P_right = P_left.copy()
    P_right[0, 3] = -P_left[0, 0] * np.linalg.norm(position)
    return CameraInfo(left, R_left, P_left), CameraInfo(right, R_right, P_right)


def _row_aligned(position: FloatArray, other_axis: FloatArray) -> FloatArray:
    """Rotation into a frame with x along the baseline and z midway between both optical axes."""
    x = position / np.linalg.norm(position)
    forward = np.array([0.0, 0.0, 1.0]) + other_axis
    z = forward - (forward @ x) * x
    z /= np.linalg.norm(z)
    return np.array([x, np.cross(z, x), z])


def _common_projection(left: Camera, R_left: FloatArray, right: Camera, R_right: FloatArray) -> FloatArray:
    windows = np.array([_inner_window(left, R_left), _inner_window(right, R_right)])
    low, high = windows[:, 0].max(axis=0), windows[:, 1].min(axis=0)
    if (high - low).min() < 0.05:
        raise ValueError("the two cameras see too little in common to be rectified as a pair")
    size = np.array([left.width, left.height], dtype=np.float64)
    focal = float(((size - 1.0) / (high - low)).max())
    cx, cy = 0.5 * (size - 1.0) - 0.5 * focal * (low + high)
    return np.array([[focal, 0.0, cx, 0.0], [0.0, focal, cy, 0.0], [0.0, 0.0, 1.0, 0.0]])


def _inner_window(camera: Camera, R: FloatArray) -> FloatArray:
    """Corners (2, 2) of a rectangle on the rectified image plane whose rays all lie inside the raw image."""
    w, h = camera.width - 1.0, camera.height - 1.0
    s = np.linspace(0.0, 1.0, 25)
    zero, one = np.zeros_like(s), np.ones_like(s)
    edges = {"left": (zero, s), "right": (one, s), "top": (s, zero), "bottom": (s, one)}
    plane = {name: _on_plane(camera, R, np.column_stack([a * w, b * h])) for name, (a, b) in edges.items()}
    low = [
        np.nanmax(plane["left"][:, 0], initial=-WIDEST_TANGENT),
        np.nanmax(plane["top"][:, 1], initial=-WIDEST_TANGENT),
    ]
    high = [
        np.nanmin(plane["right"][:, 0], initial=WIDEST_TANGENT),
        np.nanmin(plane["bottom"][:, 1], initial=WIDEST_TANGENT),
    ]
    return np.array([low, high])


def _on_plane(camera: Camera, R: FloatArray, pixels: FloatArray) -> FloatArray:
    """Rectified image-plane coordinates (n, 2) of raw pixels; NaN where the lens has no ray in front."""
    xy = camera.normalised_from_pixels(pixels)
    rotated = np.column_stack([xy, np.ones(len(xy))]) @ R.T
    z = np.where(rotated[:, 2] > 0.05, rotated[:, 2], np.nan)
    return np.asarray(rotated[:, :2] / z[:, None])
