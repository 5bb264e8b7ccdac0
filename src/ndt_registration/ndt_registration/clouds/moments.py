# SPDX-License-Identifier: Apache-2.0
"""Sums over the points in each block of a lattice: what the normal distributions of all cells are made of."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ndt_registration.clouds.block_table import (
    MAX_CELLS_PER_AXIS,
    Int32Array,
    IntArray,
    block_table,
    brick_around,
    brick_key,
    brick_of,
    has_room,
    in_one_brick,
    place_in_brick,
    with_room,
)
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

ENTRIES_PER_BRICK = 8
"""So many entries for each brick: a table has room for that many bricks at first."""
_CHUNK = 1024
"""Points whose blocks are computed at once."""
_NOWHERE: Any = np.int32(1 << 30)
"""Coordinate of no block."""


class Moments(NamedTuple):
    """Sums over the points of each block.

    Corner (m, 3) in blocks, counts (m,), sums (m, 3), outers (m, 6) xx xy xz yy yz zz.
    """

    corner: IntArray
    counts: FloatArray
    sums: FloatArray
    outers: FloatArray


@njit(cache=True, nogil=True)
def _numbered_corners(corner: IntArray, children: int) -> tuple[Int32Array, IntArray]:
    """Number (n * children,) of each entry's corners, in order of first appearance, and those corners (m, 3)."""
    n = corner.shape[0]
    table = block_table(n // ENTRIES_PER_BRICK + 8)
    number, out = np.empty(n * children, np.int32), np.empty((n * children, 3), np.int64)
    bricks, done, used = np.empty(8, np.int32), 0, 0
    while done < n:
        table = with_room(table, 8)
        done, used = _number_corners(corner, children, table, bricks, number, out, done, used)
    return number, out[:used].copy()


@in_place()
def _number_corners(corner, children, table, bricks, number, out, done, used):  # type: ignore[no-untyped-def]
    """Number the corners of entries from ``done`` on while the table has room; returns the next entry and number."""
    reach = 1 if children > 1 else 0
    while done < corner.shape[0] and has_room(table, 8):
        x, y, z = corner[done, 0], corner[done, 1], corner[done, 2]
        bricks[:] = -1
        for child in range(children):
            ix, iy, iz = x - (child & 1), y - ((child >> 1) & 1), z - (child >> 2)
            brick = brick_around(table, x - reach, y - reach, z - reach, ix, iy, iz, bricks)
            place = place_in_brick(ix, iy, iz)
            if table.rows[brick, place] < 0:
                table.rows[brick, place] = used
                out[used, 0], out[used, 1], out[used, 2] = ix, iy, iz
                used += 1
            number[done * children + child] = table.rows[brick, place]
        done += 1
    return done, used


@njit(cache=True, nogil=True)
def accumulated(
    corner: IntArray, count: FloatArray, first: FloatArray, outer: FloatArray, children: int, least: float
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Sum entries with equal corners, and keep the sums of at least ``least`` points.

    With ``children`` = 8 each entry goes to the eight corners below it as well.
    """
    number, out_corner = _numbered_corners(corner, children)
    counts = np.zeros(out_corner.shape[0])
    for i in range(number.shape[0]):
        counts[number[i]] += count[i // children]
    rows, kept = np.empty(counts.shape[0], np.int32), 0
    for i in range(counts.shape[0]):
        rows[i] = kept if counts[i] >= least else -1
        if counts[i] >= least:
            counts[kept], out_corner[kept] = counts[i], out_corner[i]
            kept += 1
    sums, outers = np.zeros((kept, 3)), np.zeros((kept, 6))
    _add_moments(number, rows, first, outer, sums, outers)
    return out_corner[:kept], counts[:kept], sums, outers


@in_place()
def _add_moments(number, rows, first, outer, sums, outers):  # type: ignore[no-untyped-def]
    """Add the moments of entries (n,) to those of the rows that their corners have, as many for each entry."""
    children = number.shape[0] // max(first.shape[0], 1)
    for i in range(first.shape[0]):
        for child in range(children):
            row = rows[number[i * children + child]]
            if row >= 0:
                for k in range(3):
                    sums[row, k] += first[i, k]
                for k in range(6):
                    outers[row, k] += outer[i, k]


@njit(cache=True, nogil=True)
def _point_moments(points: FloatArray, block_size: float) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Moments of the points' blocks, in order of first appearance."""
    n = points.shape[0]
    corner = np.empty((n, 3), np.int64)
    number = np.empty(n, np.int32)
    used = _number_blocks(points, block_size, number, corner)
    count = np.zeros(used)
    first = np.zeros((used, 3))
    outer = np.zeros((used, 6))
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        row = number[i]
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
    return corner[:used], count, first, outer


@njit(cache=True, nogil=True)
def _number_blocks(points: FloatArray, block_size: float, number: Int32Array, corner: IntArray) -> int:
    """Write the number of each point's block, in order of first appearance, and the blocks' corners; how many."""
    table = block_table(points.shape[0] // ENTRIES_PER_BRICK + 8)
    done, used = 0, 0
    while done < points.shape[0]:
        table = with_room(table, 8)
        done, used = _number_points(points, block_size, table, number, corner, done, used)
    return used


@in_place()
def _number_points(points, block_size, table, number, corner, done, used):  # type: ignore[no-untyped-def]
    """Number the blocks of points from ``done`` on while the table has room; returns the next point and number."""
    last, brick, inverse = -1, 0, 1.0 / block_size
    while done < points.shape[0] and has_room(table, 1):
        x, y, z = points[done, 0], points[done, 1], points[done, 2]
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        key = brick_key(ix, iy, iz)
        if key != last:  # neighbours in a picture often share a brick
            brick, last = brick_of(table, key), key
        place = place_in_brick(ix, iy, iz)
        if table.rows[brick, place] < 0:
            table.rows[brick, place] = used
            corner[used, 0], corner[used, 1], corner[used, 2] = ix, iy, iz
            used += 1
        number[done] = table.rows[brick, place]
        done += 1
    return done, used


@njit(cache=True, nogil=True)
def _point_counts(points: FloatArray, block_size: float) -> FloatArray:
    """Points of each block, brick by brick."""
    table = block_table(points.shape[0] // ENTRIES_PER_BRICK + 8)
    numbers, corners = points.reshape(-1), np.empty(3 * _CHUNK, np.int32)
    for first in range(0, points.shape[0], _CHUNK):
        count = min(points.shape[0] - first, _CHUNK)
        table = with_room(table, count)
        _write_corners(numbers[3 * first : 3 * (first + count)], 1.0 / block_size, corners)
        _count_points(corners, count, table)
    counts = np.empty(points.shape[0] + 1)  # one beyond the last, where what is empty is written
    return counts[: _write_counts(table, counts)]


@in_place()
def _write_corners(numbers, inverse, corners):  # type: ignore[no-untyped-def]
    """Integer coordinates of the blocks of points, number by number: a loop of its own is vectorised."""
    for i in range(numbers.shape[0]):
        corners[i] = np.int32(np.floor(numbers[i] * inverse))


@in_place()
def _count_points(corners, count, table):  # type: ignore[no-untyped-def]
    """Add so many points to the rows of their blocks, which hold -1 at first."""
    rows, brick = table.rows, 0
    last_x = last_y = last_z = _NOWHERE
    for i in range(count):
        x, y, z = corners[3 * i], corners[3 * i + 1], corners[3 * i + 2]
        if not in_one_brick(x, y, z, last_x, last_y, last_z):  # neighbours in a picture often share a brick
            brick, last_x, last_y, last_z = brick_of(table, brick_key(int(x), int(y), int(z))), x, y, z
        rows[brick, place_in_brick(x, y, z)] += 1


@in_place()
def _write_counts(table, counts):  # type: ignore[no-untyped-def]
    """Write the numbers of points of the blocks that have any; returns how many blocks."""
    used = 0
    for brick in range(table.used[0]):
        for place in range(table.rows.shape[1]):
            counts[used] = table.rows[brick, place] + 1
            used += table.rows[brick, place] >= 0
    return used


def block_counts(points: FloatArray, block_size: float) -> FloatArray:
    """Points (m,) in each block of :func:`block_moments`, in an order of its own and less time."""
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
    reach = float(np.maximum(points.max(initial=0.0), -points.min(initial=0.0))) / block_size
    if not reach < MAX_CELLS_PER_AXIS:
        raise ValueError(f"blocks of {block_size} m are too small for a cloud that reaches {reach * block_size:.3g} m")


def coarser(moments: Moments) -> Moments:
    """Moments in blocks of twice the edge."""
    return Moments(*accumulated(moments.corner >> 1, moments.counts, moments.sums, moments.outers, 1, 0.0))
