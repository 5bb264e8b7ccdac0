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

from ndt_registration.clouds.block_table import (
    BlockTable,
    Int32Array,
    IntArray,
    block_table,
    brick_around,
    find_block,
    has_room,
    place_in_brick,
    with_room,
)
from ndt_registration.clouds.eigen import LANES, symmetric_eigen3
from ndt_registration.clouds.moments import ENTRIES_PER_BRICK, Moments, accumulated
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

Float32Array = npt.NDArray[np.float32]

ABSENT = np.float32(1e18)
"""Mean of a cell that is not there: so far off that it does not count."""
SPURIOUS = 9
"""Column of a cell's record that holds the information along its plane that errors of its normal make."""


class NormalGrid(NamedTuple):
    """Normal distributions in overlapping cells of edge ``2 * block_size``, as flat arrays for the kernels.

    ``table`` holds the rows of blocks; ``cells`` (m, 8) holds the cells that cover a block, -1 where there is none;
    ``mean`` (k, 3), ``information`` (k, 6) upper triangle of the inverse covariance, ``normal`` (k, 3) direction of
    least variance, ``variance`` (k, 3) raw ascending eigenvalues, ``counts`` (k,) points. ``records`` (k + 1, 16): mean
    from the cell's own corner (3) and information (6) once more, one cell in one line of the cache, and what
    :func:`note_spurious_information` writes; the last stands for cells that are not there.
    """

    block_size: float
    table: BlockTable
    cells: Int32Array
    mean: FloatArray
    information: FloatArray
    normal: FloatArray
    variance: FloatArray
    counts: FloatArray
    records: Float32Array


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
    mean, information = np.empty((n, 3)), np.empty((n, 6))
    normal, variance = np.empty((n, 3)), np.empty((n, 3))
    room, a, vectors, values = np.empty(19 * LANES), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for start in range(0, n, LANES):
        _read_covariances(count, first, outer, start, mean, room)
        symmetric_eigen3(room, a, vectors, values)
        for j in range(min(LANES, n - start)):
            for k in range(3):
                variance[start + j, k] = max(room[(6 + k) * LANES + j], 0.0)
                normal[start + j, k] = room[(9 + k) * LANES + j]
        _invert(room, relative_floor, variance_floor, slack)
        for j in range(min(LANES, n - start)):
            for k in range(6):
                information[start + j, k] = room[k * LANES + j]
    return mean, information, normal, variance


@in_place(error_model="numpy")
def _read_covariances(count, first, outer, start, mean, room):  # type: ignore[no-untyped-def]
    """Write means (n, 3), and covariances to the first six rows of ``room``; the last one fills what would be empty."""
    last = count.shape[0] - 1
    for j in range(LANES):
        i = min(start + j, last)
        n, freedom = count[i], count[i] - 1.0
        x, y, z = first[i, 0] / n, first[i, 1] / n, first[i, 2] / n
        mean[i, 0], mean[i, 1], mean[i, 2] = x, y, z
        room[j] = (outer[i, 0] - n * x * x) / freedom
        room[LANES + j] = (outer[i, 1] - n * x * y) / freedom
        room[2 * LANES + j] = (outer[i, 2] - n * x * z) / freedom
        room[3 * LANES + j] = (outer[i, 3] - n * y * y) / freedom
        room[4 * LANES + j] = (outer[i, 4] - n * y * z) / freedom
        room[5 * LANES + j] = (outer[i, 5] - n * z * z) / freedom


@in_place(error_model="numpy")
def _invert(room, relative_floor, variance_floor, slack):  # type: ignore[no-untyped-def]
    """Information in the first six rows of ``room`` from the eigenvalues and vectors in those after them."""
    for j in range(LANES):
        floor = max(relative_floor * room[8 * LANES + j], variance_floor)
        free = slack / max(room[8 * LANES + j], floor)
        a = max(1.0 / max(room[6 * LANES + j], floor) - free, 0.0)
        b = max(1.0 / max(room[7 * LANES + j], floor) - free, 0.0)
        c = max(1.0 / max(room[8 * LANES + j], floor) - free, 0.0)
        ax, ay, az = room[9 * LANES + j], room[10 * LANES + j], room[11 * LANES + j]
        bx, by, bz = room[12 * LANES + j], room[13 * LANES + j], room[14 * LANES + j]
        cx, cy, cz = room[15 * LANES + j], room[16 * LANES + j], room[17 * LANES + j]
        room[j] = a * ax * ax + b * bx * bx + c * cx * cx
        room[LANES + j] = a * ax * ay + b * bx * by + c * cx * cy
        room[2 * LANES + j] = a * ax * az + b * bx * bz + c * cx * cz
        room[3 * LANES + j] = a * ay * ay + b * by * by + c * cy * cy
        room[4 * LANES + j] = a * ay * az + b * by * bz + c * cy * cz
        room[5 * LANES + j] = a * az * az + b * bz * bz + c * cz * cz


@njit(cache=True, nogil=True)
def _records(mean: FloatArray, information: FloatArray, corner: IntArray, block_size: float) -> Float32Array:
    """See :class:`NormalGrid`."""
    records = np.zeros((mean.shape[0] + 1, 16), np.float32)
    records[-1, 0], records[-1, 3] = ABSENT, 1.0
    for i in range(mean.shape[0]):
        for k in range(3):
            records[i, k] = mean[i, k] - block_size * corner[i, k]
        for k in range(6):
            records[i, 3 + k] = information[i, k]
    return records


@njit(cache=True, nogil=True)
def _cover(corner: IntArray) -> tuple[BlockTable, Int32Array]:
    """Table from a block to the eight cells that cover it, in a fixed order of offsets."""
    n = corner.shape[0]
    table = block_table(n // ENTRIES_PER_BRICK + 8)
    cells, bricks = np.empty((8 * n, 8), np.int32), np.empty(8, np.int32)
    done, used = 0, 0
    while done < n:
        table = with_room(table, 8)
        done, used = _cover_blocks(corner, table, bricks, cells, done, used)
    return table, cells[:used].copy()


@in_place()
def _cover_blocks(corner, table, bricks, cells, done, used):  # type: ignore[no-untyped-def]
    """Enter cells from ``done`` on at their eight blocks while the table has room; returns the next cell and row."""
    while done < corner.shape[0] and has_room(table, 8):
        x, y, z = corner[done, 0], corner[done, 1], corner[done, 2]
        bricks[:] = -1
        for child in range(8):
            ix, iy, iz = x + (child & 1), y + ((child >> 1) & 1), z + (child >> 2)
            brick, place = brick_around(table, x, y, z, ix, iy, iz, bricks), place_in_brick(ix, iy, iz)
            row = table.rows[brick, place]
            if row < 0:
                row = used
                table.rows[brick, place] = row
                for k in range(8):
                    cells[row, k] = -1
                used += 1
            cells[row, child] = done
        done += 1
    return done, used


def normal_grid(
    moments: Moments, block_size: float, *, min_points: int, relative_floor: float, variance_floor: float, slack: float
) -> NormalGrid:
    """Cells of edge ``2 * block_size`` m with at least ``min_points`` points.

    Each eigenvalue of a cell's covariance is at least ``relative_floor`` times the largest (8.2.1) and
    ``variance_floor`` m2.
    """
    corner, count, first, outer = accumulated(
        moments.corner, moments.counts, moments.sums, moments.outers, 8, max(min_points, 2)
    )
    mean, information, normal, variance = _distributions(count, first, outer, relative_floor, variance_floor, slack)
    table, cells = _cover(corner)
    records = _records(mean, information, corner, block_size)
    return NormalGrid(block_size, table, cells, mean, information, normal, variance, count, records)


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
    """Index of the cell whose centre is nearest to a place (in edges of a block), of the eight around it; -1: none."""
    ix, iy, iz = np.floor(x), np.floor(y), np.floor(z)
    row = find_block(grid.table, int(ix), int(iy), int(iz))
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
