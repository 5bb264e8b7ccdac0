# SPDX-License-Identifier: Apache-2.0
"""The compiled part of the TSDF: one depth image into the voxels of the blocks that it can see."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.camera import MIN_DEPTH
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, Float32Array

BLOCK = 8
"""Voxels along the edge of a block."""
VOXELS = BLOCK**3
_ONE = np.uintp(1)
"""Unsigned indices cannot be negative, so that the kernels need not look whether they count from the end."""


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
def surface_blocks(
    T_map_camera: FloatArray,
    intrinsics: FloatArray,
    depth: Float32Array,
    truncation: float,
    block_size: float,
    recent: npt.NDArray[np.int64],
    cells: npt.NDArray[np.int64],
) -> int:  # pragma: no cover - compiled
    """Blocks (m, 3) that rays go through before, at and behind their depth, some more than once, to ``cells``; m.

    Rays are those of every other pixel. ``recent`` (k, 3), k a power of two: room for blocks found not long ago, at
    first out of reach.
    """
    T, count = T_map_camera, 0
    for side in (-1.0, 0.0, 1.0):
        for v in range(0, depth.shape[0], 2):
            for u in range(0, depth.shape[1], 2):
                if not depth[v, u] > 0.0:
                    continue
                z = max(depth[v, u] + side * truncation, MIN_DEPTH)
                x, y = (u - intrinsics[2]) / intrinsics[0] * z, (v - intrinsics[3]) / intrinsics[1] * z
                for k in range(3):
                    place = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
                    cells[count, k] = math.floor(place / block_size)
                a, b, c = cells[count]
                slot = (a * 73856093 ^ b * 19349663 ^ c * 83492791) & (recent.shape[0] - 1)
                if recent[slot, 0] != a or recent[slot, 1] != b or recent[slot, 2] != c:
                    recent[slot, 0], recent[slot, 1], recent[slot, 2] = a, b, c
                    count += 1
    return count


@in_place(error_model="numpy")
def _look_up(u: float, v: float, depth: Float32Array, jump: float) -> float:  # pragma: no cover - compiled
    """Depth between pixels, bilinear where the four neighbours belong to one surface, else of the nearest."""
    column, row = np.uintp(u), np.uintp(v)
    upper, lower = depth[row], depth[row + _ONE]
    a, b, c, d = upper[column], upper[column + _ONE], lower[column], lower[column + _ONE]
    lowest, highest = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    fu, fv = u - column, v - row
    if lowest > 0.0 and highest - lowest < jump:
        return float((1.0 - fv) * ((1.0 - fu) * a + fu * b) + fv * ((1.0 - fu) * c + fu * d))
    return float(depth[np.uintp(v + 0.5), np.uintp(u + 0.5)])


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


@njit(cache=True, nogil=True, error_model="numpy")
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
    if min(view.depth.shape) < 2:
        return
    places = np.empty(VOXELS), np.empty(VOXELS), np.empty(VOXELS)
    pixels, chosen = np.empty(VOXELS, np.int32), np.empty(VOXELS, np.uint32)
    for b in blocks:
        _project(origins[b], voxel_size, view.T_camera_map, view.intrinsics, places)
        count = _choose(places, pixels, view.depth, truncation, chosen)
        _fill(chosen[:count], places, voxels[b], colours[b], voxel_size, truncation, view, sign)


_Places = tuple[FloatArray, FloatArray, FloatArray]
"""Column and row (px) and distance along z (m) of the voxels of a block, (512,) each."""


@in_place(error_model="numpy")
def _project(
    origin: FloatArray, voxel_size: float, T: FloatArray, intrinsics: FloatArray, out: _Places
) -> None:  # pragma: no cover - compiled
    """Places of the voxels of the block at ``origin``: no branch in the loop, so that it is vectorised."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    column, row, away = out
    for line in range(BLOCK * BLOCK):
        x = origin[0] + (line // BLOCK + 0.5) * voxel_size
        y = origin[1] + (line % BLOCK + 0.5) * voxel_size
        line_x = T[0, 0] * x + T[0, 1] * y + T[0, 3]
        line_y = T[1, 0] * x + T[1, 1] * y + T[1, 3]
        line_z = T[2, 0] * x + T[2, 1] * y + T[2, 3]
        for k in range(BLOCK):
            z = origin[2] + (k + 0.5) * voxel_size
            pz = line_z + T[2, 2] * z
            scale = 1.0 / pz
            column[line * BLOCK + k] = fx * (line_x + T[0, 2] * z) * scale + cx
            row[line * BLOCK + k] = fy * (line_y + T[1, 2] * z) * scale + cy
            away[line * BLOCK + k] = pz


@in_place(error_model="numpy")
def _choose(
    places: _Places,
    pixels: npt.NDArray[np.int32],
    depth: Float32Array,
    truncation: float,
    chosen: npt.NDArray[np.uint32],
) -> int:  # pragma: no cover - compiled
    """Write the numbers of voxels that may lie before what their pixels show, or near it, to ``chosen``; how many.

    What is between pixels is less than ``truncation`` from the nearest. No branch in the loops: it would be foreseen
    wrongly for every other voxel. ``pixels`` (512,): room.
    """
    columns, rows, away = places
    last_row, last_column, width = depth.shape[0] - 1, depth.shape[1] - 1, np.int32(depth.shape[1])
    for i in range(VOXELS):
        u, v = columns[i], rows[i]
        inside = (away[i] >= MIN_DEPTH) & (u >= 0.0) & (v >= 0.0) & (u < last_column) & (v < last_row)
        u, v = (u if inside else 0.0), (v if inside else 0.0)
        pixel = np.int32(v + 0.5) * width + np.int32(u + 0.5)
        pixels[i] = pixel if inside else -1
    values, count = depth.reshape(depth.size), 0
    for i in range(VOXELS):
        pixel = pixels[i]
        nearest = values[np.uint32(max(pixel, 0))]
        chosen[count] = i
        count += (pixel >= 0) & (nearest > 0.0) & (nearest - away[i] > -2.0 * truncation)
    return count


@in_place(error_model="numpy")
def _fill(
    chosen: npt.NDArray[np.uint32],
    places: _Places,
    voxels: Float32Array,
    colours: ByteArray,
    voxel_size: float,
    truncation: float,
    view: DepthView,
    sign: float,
) -> None:  # pragma: no cover - compiled
    """Add an image to the ``chosen`` voxels (512, 4) of one block at ``places``."""
    columns, rows, away = places
    for i in chosen:
        measured = _look_up(columns[i], rows[i], view.depth, truncation)
        if measured - away[i] < -truncation:
            continue
        row, column = np.uintp(rows[i] + 0.5), np.uintp(columns[i] + 0.5)
        noise = view.sigma[row, column]
        if not noise > 0.0:
            continue
        distance = _add_distance(voxels[i], measured - away[i], noise, voxel_size, truncation, sign)
        if view.picture.shape[0] > 0 and sign > 0.0 and abs(distance) < 1.5 * voxel_size:
            _blend(colours[i], view.picture[row, column])


@in_place(error_model="numpy")
def _blend(mean: ByteArray, colour: ByteArray) -> None:  # pragma: no cover - compiled
    """Take one more colour into a mean over at most 16: bytes could not follow a longer one."""
    count = min(int(mean[3]) + 1, 16)
    for k in range(3):
        step = (float(colour[k]) - float(mean[k])) / count
        mean[k] = np.uint8(min(max(math.floor(float(mean[k]) + step + 0.5), 0.0), 255.0))
    mean[3] = count
