# SPDX-License-Identifier: Apache-2.0
"""The compiled part of the TSDF: one depth image into the voxels of the blocks that it can see."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slam_core.camera import MIN_DEPTH
from slam_core.geometry import FloatArray
from slam_core.in_place import in_place
from slam_core.types import ByteArray, Float32Array

BLOCK = 8
"""Voxels along the edge of a block."""


class DepthView(NamedTuple):
    """A depth image with its pose.

    T_camera_map (4, 4); intrinsics fx, fy, cx, cy (px); depth and sigma (height, width) m, 0 where there is none;
    picture (height, width, 3), or of no size where there is none.
    """

    T_camera_map: FloatArray
    intrinsics: FloatArray
    depth: Float32Array
    sigma: Float32Array
    picture: ByteArray


@in_place(error_model="numpy")
def _look_up(u: float, v: float, depth: Float32Array, jump: float) -> float:  # pragma: no cover - compiled
    """Depth at a pixel, bilinear where the four neighbours belong to one surface, else of the nearest; 0: none."""
    height, width = depth.shape
    column, row = math.floor(u), math.floor(v)
    if column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return 0.0
    a, b = float(depth[row, column]), float(depth[row, column + 1])
    c, d = float(depth[row + 1, column]), float(depth[row + 1, column + 1])
    lowest, highest = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    fu, fv = u - column, v - row
    if lowest > 0.0 and highest - lowest < jump:
        return (1.0 - fv) * ((1.0 - fu) * a + fu * b) + fv * ((1.0 - fu) * c + fu * d)
    return float(depth[int(v + 0.5), int(u + 0.5)])


@in_place(error_model="numpy")
def _add_distance(
    voxel: Float32Array, distance: float, noise: float, voxel_size: float, truncation: float, sign: float
) -> float:  # pragma: no cover - compiled
    """Distance of a voxel before the surface, cut off at ``truncation``, when it is added with its weight."""
    weight = 1.0 / (noise * noise)
    if distance < -voxel_size:  # behind the surface nothing was seen: what is told of it fades
        weight *= (truncation + distance) / (truncation - voxel_size)
    distance = min(distance, truncation)
    voxel[0] += sign * weight * distance
    voxel[1] += sign * weight
    voxel[2] += sign * weight * distance * distance
    voxel[3] += sign
    return distance


@in_place(error_model="numpy")
def integrate(
    blocks: npt.NDArray[np.int64],
    origins: FloatArray,
    voxels: Float32Array,
    colours: ByteArray,
    voxel_size: float,
    truncation: float,
    view: DepthView,
    sign: float,
) -> None:  # pragma: no cover - compiled
    """Add (sign 1) or take away (sign -1) one depth image in ``blocks`` (m,); their corners are ``origins`` (n, 3) m.

    voxels: (n, 512, 4) sum of weighted distance, of weight, of weighted squared distance, and number of images.
    colours: (n, 512, 4) mean red, green, blue and of how many images. truncation: largest distance kept, m.
    """
    T = view.T_camera_map
    fx, fy, cx, cy = view.intrinsics[0], view.intrinsics[1], view.intrinsics[2], view.intrinsics[3]
    for b in blocks:
        for i in range(BLOCK * BLOCK * BLOCK):
            if i % BLOCK == 0:  # the next column of voxels along z
                x = origins[b, 0] + (i // (BLOCK * BLOCK) + 0.5) * voxel_size
                y = origins[b, 1] + ((i // BLOCK) % BLOCK + 0.5) * voxel_size
                column_x = T[0, 0] * x + T[0, 1] * y + T[0, 3]
                column_y = T[1, 0] * x + T[1, 1] * y + T[1, 3]
                column_z = T[2, 0] * x + T[2, 1] * y + T[2, 3]
            z = origins[b, 2] + (i % BLOCK + 0.5) * voxel_size
            pz = column_z + T[2, 2] * z
            if pz < MIN_DEPTH:
                continue
            u, v = fx * ((column_x + T[0, 2] * z) / pz) + cx, fy * ((column_y + T[1, 2] * z) / pz) + cy
            measured = _look_up(u, v, view.depth, truncation)
            if not measured > 0.0 or measured - pz < -truncation:
                continue
            row, column = int(v + 0.5), int(u + 0.5)
            noise = view.sigma[row, column]
            if not noise > 0.0:
                continue
            distance = _add_distance(voxels[b, i], measured - pz, noise, voxel_size, truncation, sign)
            if view.picture.shape[0] > 0 and sign > 0.0 and abs(distance) < 1.5 * voxel_size:
                _blend(colours[b, i], view.picture[row, column])


@in_place(error_model="numpy")
def _blend(mean: ByteArray, colour: ByteArray) -> None:  # pragma: no cover - compiled
    """Take one more colour into a mean over at most 16: bytes could not follow a longer one."""
    count = min(int(mean[3]) + 1, 16)
    for k in range(3):
        step = (float(colour[k]) - float(mean[k])) / count
        mean[k] = np.uint8(min(max(math.floor(float(mean[k]) + step + 0.5), 0.0), 255.0))
    mean[3] = count
