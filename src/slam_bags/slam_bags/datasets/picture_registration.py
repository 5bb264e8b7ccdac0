# SPDX-License-Identifier: Apache-2.0
"""Brings the colour camera's picture into the depth camera's image, where the two are different cameras.

An unregistered Kinect sees the same point some 20 pixels apart in its two images: a feature of the picture would get
the depth of its neighbour. The depth stays as it was measured; the picture is looked up where the point of each depth
pixel falls in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from slam_core.camera import Camera
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray


@dataclass(frozen=True, eq=False)
class ColourCamera:
    """A colour camera beside a depth camera: fx fy cx cy (px), its centre in the depth camera's optical frame (m)."""

    intrinsics: tuple[float, float, float, float]
    position: tuple[float, float, float]


def register_pictures(
    pictures: tuple[ByteArray, ...], depth_m: AnyArray, depth_camera: Camera, colour: ColourCamera
) -> tuple[ByteArray, ...]:
    """The pictures of a colour camera as the depth camera would have taken them, in the pixels of the depth image.

    Pixels without depth take that of their nearest neighbour with depth, so that the picture has no holes; pictures
    with no depth at all are returned as they are. ``depth_m`` is along z, m; zero or not finite where there is none.
    """
    known = np.isfinite(depth_m) & (depth_m > 0.0)
    if not known.any():
        return pictures
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    z = np.asarray(depth_m, dtype=np.float64)[tuple(nearest)]
    u, v = _pixels_in_picture(z, depth_camera, colour)
    return tuple(
        np.asarray(cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)) for picture in pictures
    )


def _pixels_in_picture(z: FloatArray, camera: Camera, colour: ColourCamera) -> tuple[AnyArray, AnyArray]:
    x = (np.arange(camera.width) - camera.cx) / camera.fx * z - colour.position[0]
    y = (np.arange(camera.height)[:, None] - camera.cy) / camera.fy * z - colour.position[1]
    fx, fy, cx, cy = colour.intrinsics
    ahead = z - colour.position[2]
    return (fx * x / ahead + cx).astype(np.float32), (fy * y / ahead + cy).astype(np.float32)
