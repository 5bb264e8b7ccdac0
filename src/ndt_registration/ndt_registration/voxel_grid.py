# SPDX-License-Identifier: Apache-2.0
"""Overlapping cells of normal distributions over a point cloud, found through a hash table.

The eight grids of the thesis (8.2.2), shifted by half a cell, are together all cubes of edge ``h`` whose corner lies on
a lattice of spacing ``h / 2``. So the moments are summed once in blocks of edge ``h / 2``, and each cell is the sum of
eight blocks: the eight overlapping grids cost one pass over the points. A point lies in exactly eight cells, and all
points of one block lie in the same eight: one look-up finds them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.block_table import (
    MAX_CELLS_PER_AXIS,
    Int32Array,
    IntArray,
    doubled,
    find_block,
    hash_table,
    pack_key,
    slot_of,
)
from ndt_registration.eigen import symmetric_eigen3
from slam_core.geometry import FloatArray
from slam_core.in_place import in_place

Float32Array = npt.NDArray[np.float32]

_SHARED = 2
"""So many corners for each entry are made room for at first: surfaces need two to three for each."""
SPURIOUS = 9
"""Column of a cell's record that holds the information along its plane that errors of its normal make."""


class Moments(NamedTuple):
    """Sums over the points of each block.

    Corner (m, 3) in blocks, counts (m,), sums (m, 3), outers (m, 6) xx xy xz yy yz zz.
    """

    corner: IntArray
    counts: FloatArray
    sums: FloatArray
    outers: FloatArray


class NormalGrid(NamedTuple):
    """Normal distributions in overlapping cells of edge ``2 * block_size``, as flat arrays for the kernels.

    ``keys`` and ``rows`` are the hash table of blocks; ``cells`` (m, 8) holds the cells that cover a block, -1 where
    there is none; ``mean`` (k, 3), ``information`` (k, 6) upper triangle of the inverse covariance, ``normal`` (k, 3)
    direction of least variance, ``variance`` (k, 3) raw ascending eigenvalues, ``counts`` (k,) points. ``records``
    (k, 16): mean from the cell's own corner (3) and information (6) once more, one cell in one line of the cache, and
    what :func:`note_spurious_information` writes.
    """

    block_size: float
    keys: IntArray
    rows: Int32Array
    cells: Int32Array
    mean: FloatArray
    information: FloatArray
    normal: FloatArray
    variance: FloatArray
    counts: FloatArray
    records: Float32Array


@njit(cache=True, nogil=True)
def _numbered_corners(corner: IntArray, children: int) -> tuple[Int32Array, IntArray]:
    """Number (n * children,) of each entry's corners, in order of first appearance, and those corners (m, 3).

    The table starts with the room that surfaces take, where children share most corners, and grows where that fails.
    """
    n = corner.shape[0]
    keys = hash_table(n * _SHARED if children > 1 else n)
    rows = np.empty(keys.shape[0], np.int32)
    number, out = np.empty(n * children, np.int32), np.empty((n * children, 3), np.int64)
    used = 0
    for i in range(n):
        if 2 * (used + children) > keys.shape[0]:
            keys, rows = doubled(keys, rows)
        for child in range(children):
            ix = corner[i, 0] - (child & 1)
            iy = corner[i, 1] - ((child >> 1) & 1)
            iz = corner[i, 2] - (child >> 2)
            key = pack_key(ix, iy, iz)
            slot = slot_of(keys, key)
            if keys[slot] == -1:
                keys[slot], rows[slot] = key, used
                out[used, 0], out[used, 1], out[used, 2] = ix, iy, iz
                used += 1
            number[i * children + child] = rows[slot]
    return number, out[:used].copy()


@njit(cache=True, nogil=True)
def _accumulate(
    corner: IntArray, count: FloatArray, first: FloatArray, outer: FloatArray, children: int
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Sum entries with equal corners; with ``children`` = 8 each entry goes to the eight corners below it as well."""
    number, out_corner = _numbered_corners(corner, children)
    used = out_corner.shape[0]
    out_count, out_sum, out_outer = np.zeros(used), np.zeros((used, 3)), np.zeros((used, 6))
    for i in range(corner.shape[0]):
        for child in range(children):
            row = number[i * children + child]
            out_count[row] += count[i]
            for k in range(3):
                out_sum[row, k] += first[i, k]
            for k in range(6):
                out_outer[row, k] += outer[i, k]
    return out_corner, out_count, out_sum, out_outer


@njit(cache=True, nogil=True)
def _point_moments(points: FloatArray, block_size: float) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Moments of the points' blocks, in order of first appearance."""
    n = points.shape[0]
    keys = hash_table(n)
    rows = np.empty(keys.shape[0], np.int32)
    corner = np.empty((n, 3), np.int64)
    count = np.zeros(n)
    first = np.zeros((n, 3))
    outer = np.zeros((n, 6))
    used, last, row = 0, -1, 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        ix, iy, iz = int(np.floor(x / block_size)), int(np.floor(y / block_size)), int(np.floor(z / block_size))
        key = pack_key(ix, iy, iz)
        if key != last:  # neighbours in the list often share a block
            slot = slot_of(keys, key)
            if keys[slot] == -1:
                keys[slot] = key
                rows[slot] = used
                corner[used, 0], corner[used, 1], corner[used, 2] = ix, iy, iz
                used += 1
            last, row = key, int(rows[slot])
        count[row] += 1.0
        first[row, 0] += x
        first[row, 1] += y
        first[row, 2] += z
        outer[row, 0] += x * x
        outer[row, 1] += x * y
        outer[row, 2] += x * z
        outer[row, 3] += y * y
        outer[row, 4] += y * z
        outer[row, 5] += z * z
    return corner[:used], count[:used], first[:used], outer[:used]


@njit(cache=True, nogil=True)
def _distributions(
    count: FloatArray,
    first: FloatArray,
    outer: FloatArray,
    relative_floor: float,
    variance_floor: float,
    slack: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean, information, normal and raw eigenvalues of each cell; see :func:`normal_grid` for floor and slack."""
    n = count.shape[0]
    mean = np.empty((n, 3))
    information = np.empty((n, 6))
    normal = np.empty((n, 3))
    variance = np.empty((n, 3))
    a = np.empty((3, 3))
    vectors = np.empty((3, 3))
    values = np.empty(3)
    for i in range(n):
        for k in range(3):
            mean[i, k] = first[i, k] / count[i]
        m = 0
        for r in range(3):
            for c in range(r, 3):
                a[r, c] = (outer[i, m] - count[i] * mean[i, r] * mean[i, c]) / (count[i] - 1.0)
                a[c, r] = a[r, c]
                m += 1
        symmetric_eigen3(a, vectors, values)
        floor = max(relative_floor * values[2], variance_floor)
        free = slack / max(values[2], floor)
        m = 0
        for r in range(3):
            normal[i, r] = vectors[r, 0]
            variance[i, r] = max(values[r], 0.0)
            for c in range(r, 3):
                s = 0.0
                for k in range(3):
                    s += vectors[r, k] * vectors[c, k] * max(1.0 / max(values[k], floor) - free, 0.0)
                information[i, m] = s
                m += 1
    return mean, information, normal, variance


@njit(cache=True, nogil=True)
def _cover(corner: IntArray) -> tuple[IntArray, Int32Array, Int32Array]:
    """Hash table from a block to the eight cells that cover it, in a fixed order of offsets."""
    n = corner.shape[0]
    keys = hash_table(_SHARED * n)
    rows = np.empty(keys.shape[0], np.int32)
    cells = np.empty((8 * n, 8), np.int32)
    used = 0
    for i in range(n):
        if 2 * (used + 8) > keys.shape[0]:
            keys, rows = doubled(keys, rows)
        for child in range(8):
            key = pack_key(corner[i, 0] + (child & 1), corner[i, 1] + ((child >> 1) & 1), corner[i, 2] + (child >> 2))
            slot = slot_of(keys, key)
            if keys[slot] == -1:
                keys[slot], rows[slot] = key, used
                cells[used] = -1
                used += 1
            cells[rows[slot], child] = i
    return keys, rows, cells[:used].copy()


@njit(cache=True, nogil=True)
def _point_counts(points: FloatArray, block_size: float) -> FloatArray:
    """Points of each block, in order of first appearance."""
    n = points.shape[0]
    keys, count = hash_table(n), np.zeros(n)
    rows = np.empty(keys.shape[0], np.int32)
    return count[: _count_points(points, block_size, keys, rows, count)]


@in_place()
def _count_points(points: FloatArray, block_size: float, keys: IntArray, rows: Int32Array, count: FloatArray) -> int:
    """Fill an empty table, and ``count`` row by row; returns the number of blocks."""
    used, last, row = 0, -1, 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        key = pack_key(int(np.floor(x / block_size)), int(np.floor(y / block_size)), int(np.floor(z / block_size)))
        if key != last:  # neighbours in a picture often share a block
            slot = slot_of(keys, key)
            if keys[slot] == -1:
                keys[slot] = key
                rows[slot] = used
                used += 1
            last, row = key, int(rows[slot])
        count[row] += 1.0
    return used


def block_counts(points: FloatArray, block_size: float) -> FloatArray:
    """Points (m,) in each block of :func:`block_moments`, in half of the time."""
    _require_keys(points, block_size)
    return np.asarray(_point_counts(np.ascontiguousarray(points, dtype=np.float64), block_size))


def block_moments(points: FloatArray, block_size: float) -> Moments:
    """Sums over the points, shape (n, 3) m, in blocks of edge ``block_size`` m.

    Raises
    ------
    ValueError
        If the blocks are so small beside the extent of the cloud that their coordinates overflow the hash key.
    """
    _require_keys(points, block_size)
    return Moments(*_point_moments(np.ascontiguousarray(points, dtype=np.float64), block_size))


def _require_keys(points: FloatArray, block_size: float) -> None:
    reach = float(np.abs(points).max(initial=0.0)) / block_size
    if not reach < MAX_CELLS_PER_AXIS:
        raise ValueError(f"blocks of {block_size} m are too small for a cloud that reaches {reach * block_size:.3g} m")


def coarser(moments: Moments) -> Moments:
    """Moments in blocks of twice the edge."""
    return Moments(*_accumulate(moments.corner >> 1, moments.counts, moments.sums, moments.outers, 1))


def normal_grid(
    moments: Moments, block_size: float, *, min_points: int, relative_floor: float, variance_floor: float, slack: float
) -> NormalGrid:
    """Cells of edge ``2 * block_size`` m with at least ``min_points`` points.

    Each eigenvalue of a cell's covariance is at least ``relative_floor`` times the largest (8.2.1) and
    ``variance_floor`` m2.
    """
    corner, count, first, outer = _accumulate(moments.corner, moments.counts, moments.sums, moments.outers, 8)
    keep = count >= max(min_points, 2)
    count = count[keep]
    mean, information, normal, variance = _distributions(
        count, first[keep], outer[keep], relative_floor, variance_floor, slack
    )
    corner = corner[keep]
    keys, rows, cells = _cover(corner)
    records = np.zeros((len(mean), 16), np.float32)
    records[:, :3], records[:, 3:9] = mean - block_size * corner, information
    return NormalGrid(block_size, keys, rows, cells, mean, information, normal, variance, count, records)


def plane_fits(moments: Moments, min_points: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (k, 3), direction of least variance (k, 3) and ascending variances (k, 3) of blocks with enough points."""
    keep = moments.counts >= max(min_points, 2)
    mean, _, normal, variance = _distributions(
        moments.counts[keep], moments.sums[keep], moments.outers[keep], 0.0, _TINY, 0.0
    )
    return mean, normal, variance


_TINY = 1e-12


@in_place()
def _nearest_cell(grid: NormalGrid, x: float, y: float, z: float) -> int:
    """Of the eight cells around a place (in edges of a block), that whose centre is nearest; -1: none."""
    ix, iy, iz = np.floor(x), np.floor(y), np.floor(z)
    row = find_block(grid.keys, grid.rows, int(ix), int(iy), int(iz))
    if row < 0:
        return -1
    return int(grid.cells[row, int(x - ix < 0.5) + 2 * int(y - iy < 0.5) + 4 * int(z - iz < 0.5)])


@in_place()
def _set_plane_information(grid: NormalGrid, i: int, n: FloatArray, floor: float, slack: float) -> None:
    """Information of a cell across its plane alone."""
    thickness = max(grid.variance[i, 0], floor)
    information = max(1.0 / thickness - slack / max(grid.variance[i, 2], thickness), 0.0)
    m = 0
    for r in range(3):
        for c in range(r, 3):
            grid.information[i, m] = information * n[r] * n[c]
            grid.records[i, 3 + m] = grid.information[i, m]
            m += 1


@in_place()
def adopt_planes(
    grid: NormalGrid, wider: NormalGrid, flatness: float, agreement: float, floor: float, slack: float
) -> None:
    """Give each cell the normal of the cell of twice its edge around it, where its own points do not contradict that.

    The direction of a cell's normal errs by its thickness over its width and the root of its points, for a small piece
    of a noisy wall by degrees: enough to hold points that should slide along. The wider normal errs sixteen times less
    in variance. Thickness alone hardly tells a picture or a skirting board from the wall behind it; where the cell's
    mean lies, and how it is turned, does. The mean stays the cell's own: means err independently and average out,
    while that of a wider plane with a step in it is wrong for either side. Cells are changed in place; with ``slack``
    >= 0 their information becomes that of the plane alone.

    wider: the next coarser grid, changed before. flatness: largest ratio of the wider cell's thickness to the cell's
    own, as variances. agreement: how far the cell's mean may lie off the wider plane, and its normal off the wider one,
    in standard deviations. floor: least variance across the plane, m2. slack: see :func:`normal_grid`.
    """
    size = wider.block_size
    for i in range(grid.mean.shape[0]):
        cell = _nearest_cell(wider, grid.mean[i, 0] / size, grid.mean[i, 1] / size, grid.mean[i, 2] / size)
        across = max(grid.variance[i, 0], floor)
        if cell < 0 or wider.variance[cell, 0] > flatness * across:
            continue
        n = wider.normal[cell]
        offset = cosine = 0.0
        for k in range(3):
            offset += n[k] * (grid.mean[i, k] - wider.mean[cell, k])
            cosine += n[k] * grid.normal[i, k]
        slope = (1.0 - cosine * cosine) * grid.variance[i, 1]
        if max(offset * offset, slope) * grid.counts[i] > agreement * agreement * across:
            continue
        for k in range(3):
            grid.normal[i, k] = n[k]
            grid.variance[i, k] = wider.variance[cell, k]
        grid.counts[i] = wider.counts[cell]
        if slack >= 0.0:
            _set_plane_information(grid, i, n, floor, slack)


@in_place()
def note_spurious_information(grid: NormalGrid) -> None:
    """Write what a normal from ``n`` points, off by ``sqrt(variance / (n spread))``, seems to hold along the plane."""
    for i in range(grid.mean.shape[0]):
        # In the plane the least variance is that of z, which is zero, and the second is across the wall.
        flat = grid.variance[i, 0] <= 1e-9 * grid.variance[i, 2]
        spread = grid.variance[i, 2] if flat else grid.variance[i, 1]
        b = grid.information[i]
        grid.records[i, SPURIOUS] = min(1.0 / max(grid.counts[i] * spread, 1e-300), b[0] + b[3] + b[5])
