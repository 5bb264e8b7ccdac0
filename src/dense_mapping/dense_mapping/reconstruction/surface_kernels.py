# SPDX-License-Identifier: Apache-2.0
"""The compiled parts of the surface: marching cubes over known voxels, connected pieces, normals.

PyMCubes' own loop takes 47 ns per voxel and knows nothing of voxels that were not seen; both cut in the same way.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from dense_mapping.reconstruction.cube_triangles import Triangles
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import Float32Array

Faces = npt.NDArray[np.int32]


@in_place()
def fill_means(
    voxels: Float32Array,
    blocks: npt.NDArray[np.int64],
    corners: npt.NDArray[np.int64],
    limits: tuple[float, float],
    noise: tuple[float, float],
    cube: Float32Array,
) -> None:  # pragma: no cover - compiled
    """Mean distances m of the voxels (n, 512, 4) of ``blocks`` (m,) to ``corners`` (m, 3) of a cube of voxels.

    Voxels that are not seen well enough keep their values. ``limits``: fewest images, largest sigma; ``noise``:
    share of the variance that images have in common, sigma that stays.
    """
    for b in range(blocks.shape[0]):
        for i in range(voxels.shape[1]):
            weighted, weight, squared, number = voxels[blocks[b], i]
            count = np.float64(number)
            if not (number >= limits[0] - 0.5 and weight > 0.0):
                continue
            mean = weighted / np.float64(weight)
            spread = max(squared - weighted * mean, 0.0) / max(count - 1.0, 1.0)
            variance = max(spread, 1.0) * (1.0 + (count - 1.0) * noise[0]) / weight + noise[1] * noise[1]
            if np.sqrt(variance) <= limits[1]:
                x, y, z = corners[b, 0] + i // 64, corners[b, 1] + i // 8 % 8, corners[b, 2] + i % 8
                cube[x, y, z] = mean


@njit(cache=True, nogil=True)
def march(
    distance: Float32Array, table: Triangles
) -> tuple[FloatArray, npt.NDArray[np.int32], Faces]:  # pragma: no cover - compiled
    """Zero level of a cube of distances (n, n, n), NaN where unknown: vertices, their nearest voxels, triangles.

    All three (m, 3); a triangle between known and unknown voxels is left out.
    """
    size = distance.shape[0] - 1
    codes = np.zeros((size, size, size), np.uint8)
    count = _find_codes(distance, table, codes)
    vertices, voxels = np.empty((3 * count, 3)), np.empty((3 * count, 3), np.int32)
    faces = np.empty((count, 3), np.int32)
    numbers = np.full((size + 1, size + 1, size + 1, 3), -1, np.int32)
    made = known = 0
    corner = np.empty(3, np.int64)
    for x in range(size):
        for y in range(size):
            for z in range(size):
                code = codes[x, y, z]
                if code == 0 or code == 255:
                    continue
                for t in range(table.shape[1]):
                    if table[code, t, 0] < 0:
                        break
                    whole = True
                    for k in range(3):
                        edge = table[code, t, k]
                        axis = edge >> 3
                        corner[0], corner[1], corner[2] = x + (edge >> 2 & 1), y + (edge >> 1 & 1), z + (edge & 1)
                        number = numbers[corner[0], corner[1], corner[2], axis]
                        if number == -1:
                            number = _vertex(distance, corner, axis, vertices, voxels, known)
                            numbers[corner[0], corner[1], corner[2], axis] = number
                            known += number >= 0
                        whole &= number >= 0
                        faces[made, 2 - k] = number
                    made += whole
    return vertices[:known], voxels[:known], faces[:made]


@in_place()
def _find_codes(
    distance: Float32Array, table: Triangles, codes: npt.NDArray[np.uint8]
) -> int:  # pragma: no cover - compiled
    """Write the code of each cube, as :func:`triangle_table` has it; return the number of triangles that they make."""
    count = 0
    for x in range(codes.shape[0]):
        for y in range(codes.shape[1]):
            a, b, c, d = distance[x, y], distance[x, y + 1], distance[x + 1, y], distance[x + 1, y + 1]
            lower = 0
            for z in range(distance.shape[2]):
                upper = (a[z] <= 0.0) | (b[z] <= 0.0) << 2 | (c[z] <= 0.0) << 4 | (d[z] <= 0.0) << 6
                code = lower | upper << 1
                lower = upper
                if z > 0 and code != 0 and code != 255:
                    codes[x, y, z - 1] = code
                    for t in range(table.shape[1]):
                        count += table[code, t, 0] >= 0
    return count


@in_place()
def _vertex(
    distance: Float32Array,
    corner: npt.NDArray[np.int64],
    axis: int,
    vertices: FloatArray,
    voxels: npt.NDArray[np.int32],
    number: int,
) -> int:  # pragma: no cover - compiled
    """Put the zero on the edge from ``corner`` along an axis into row ``number``; -2 if an end is unknown."""
    x, y, z = corner
    first = np.float64(distance[x, y, z])
    second = np.float64(distance[x + (axis == 0), y + (axis == 1), z + (axis == 2)])
    if np.isnan(first) or np.isnan(second):
        return -2
    for k in range(3):
        vertices[number, k] = corner[k]
        voxels[number, k] = corner[k]
    vertices[number, axis] += (0.0 - first) / (second - first)
    voxels[number, axis] = np.rint(vertices[number, axis])
    return number


@njit(cache=True, nogil=True)
def pieces(faces: Faces, count: int) -> Faces:  # pragma: no cover - compiled
    """A number for each connected piece of a mesh with ``count`` vertices, by vertex (count,)."""
    parent = np.arange(count).astype(np.int32)
    for f in range(faces.shape[0]):
        first = _root(parent, faces[f, 0])
        for k in range(1, 3):
            other = _root(parent, faces[f, k])
            lower, higher = min(first, other), max(first, other)
            parent[higher] = lower
            first = lower
    for i in range(count):
        parent[i] = parent[parent[i]]  # a parent comes before its children
    return parent


@in_place()
def _root(parent: Faces, i: int) -> int:  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@in_place()
def add_normals(points: Float32Array, faces: Faces, total: FloatArray) -> None:  # pragma: no cover - compiled
    """Add to every vertex (n, 3) the normals of the triangles around it, as long as twice their area."""
    for f in range(faces.shape[0]):
        i, j, k = faces[f]
        ax, ay, az = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        bx, by, bz = points[j, 0] - ax, points[j, 1] - ay, points[j, 2] - az
        cx, cy, cz = points[k, 0] - ax, points[k, 1] - ay, points[k, 2] - az
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        for corner in range(3):
            total[faces[f, corner], 0] += x
            total[faces[f, corner], 1] += y
            total[faces[f, corner], 2] += z
