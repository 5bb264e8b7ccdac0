# SPDX-License-Identifier: Apache-2.0
"""Points in groups of 32 lanes, each with the eight cells around it, for kernels that compute a whole group at once.

From one pose to the next most points stay in their block, so each keeps a copy of the cells around it, number by number
beside those of the other lanes: the next pose neither looks them up nor gathers them, and the compiler works on eight
or sixteen lanes by one instruction. Offsets from a block's corner are small, so float32 holds them to a millionth of a
block; what is summed over groups is float64. All arrays of lanes are flat: only offsets that the compiler knows let it
see that rows do not overlap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.clouds.block_table import MAX_CELLS_PER_AXIS, Int32Array, find_block
from ndt_registration.clouds.voxel_grid import ABSENT, NormalGrid
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

Float32Array = npt.NDArray[np.float32]

LANES = 32
_ROW = np.uintp(LANES)
"""Unsigned, which spares the look whether an index counts from the end."""
_VALUES = 9
"""Numbers of a cell: mean from the block's corner (3) and information (6)."""
NOWHERE = -(2**31)
"""Coordinate that no block has."""
_REACH = float(MAX_CELLS_PER_AXIS)
FAR = np.float32(20.0)
"""Half a squared Mahalanobis distance beyond which a cell does not count."""
_SIXTEENTH = np.float32(-1.0 / 16.0)
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_C3, _C4, _C5, _C6 = np.float32(1 / 6), np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)


class Neighbours(NamedTuple):
    """Cells around each point, from the last pose, and room for one group.

    block (32 g, 4): integer coordinates of the block and its row in the grid, -1 where there is none. cells (g, 8 9
    32): mean from the block's corner (3) and information (6) of eight cells. turned (96,): ``R x``. place (96,): moved
    point from its block's corner. corner (96,): coordinates of the block. sums (512,): see :func:`sum_over_cells`.
    """

    block: Int32Array
    cells: Float32Array
    turned: Float32Array
    place: Float32Array
    corner: Int32Array
    sums: Float32Array


@njit(cache=True, nogil=True)
def groups_of(points: int) -> int:
    """Number of groups that hold so many points."""
    return (points + LANES - 1) // LANES


@njit(cache=True, nogil=True)
def no_neighbours(groups: int) -> Neighbours:
    """Room for so many groups of points, none of them looked up yet."""
    return Neighbours(
        np.full((groups * LANES, 4), NOWHERE, np.int32),
        np.empty((groups, 8 * _VALUES * LANES), np.float32),
        np.zeros(3 * LANES, np.float32),
        np.zeros(3 * LANES, np.float32),
        np.zeros(3 * LANES, np.int32),
        np.zeros(16 * LANES, np.float32),
    )


@in_place()
def gather(
    points: FloatArray, group: int, grid: NormalGrid, R: FloatArray, t: FloatArray, at: Neighbours, first: int
) -> int:
    """Move the points (n, 3) of a group and look up the cells around them; returns how many points there are.

    ``first``: the layer's first group in ``at``.
    """
    count = int(min(points.shape[0] - group * LANES, LANES))
    _move(points, group * LANES, count, R, t, grid.block_size, at.turned, at.place, at.corner)
    cells, begin = at.cells[first + group], (first + group) * LANES
    for j in range(count):
        block = at.block[begin + j]
        ix, iy, iz = at.corner[j], at.corner[LANES + j], at.corner[2 * LANES + j]
        if block[0] != ix or block[1] != iy or block[2] != iz:
            _look_up(grid, ix, iy, iz, block, cells, j)
    for j in range(count, LANES):
        if at.block[begin + j, 3] != -1:
            at.block[begin + j, 3] = -1
            for k in range(8):
                _set_absent(cells, np.uintp(k * _VALUES * LANES + j))
    return count


@in_place()
def _move(
    points: FloatArray,
    first: int,
    count: int,
    R: FloatArray,
    t: FloatArray,
    size: float,
    turned: Float32Array,
    place: Float32Array,
    corner: Int32Array,
) -> None:
    inverse_size = 1.0 / size
    xa, xb, xc, xt = R[0, 0], R[0, 1], R[0, 2], t[0]
    ya, yb, yc, yt = R[1, 0], R[1, 1], R[1, 2], t[1]
    za, zb, zc, zt = R[2, 0], R[2, 1], R[2, 2], t[2]
    for j in range(count):
        x, y, z = points[first + j, 0], points[first + j, 1], points[first + j, 2]
        px = xa * x + xb * y + xc * z
        py = ya * x + yb * y + yc * z
        pz = za * x + zb * y + zc * z
        mx, my, mz = px + xt, py + yt, pz + zt
        ix = min(max(np.floor(mx * inverse_size), -_REACH), _REACH)
        iy = min(max(np.floor(my * inverse_size), -_REACH), _REACH)
        iz = min(max(np.floor(mz * inverse_size), -_REACH), _REACH)
        turned[j], turned[LANES + j], turned[2 * LANES + j] = px, py, pz
        place[j], place[LANES + j], place[2 * LANES + j] = mx - ix * size, my - iy * size, mz - iz * size
        corner[j], corner[LANES + j], corner[2 * LANES + j] = np.int32(ix), np.int32(iy), np.int32(iz)


# Inlined here: a call would pass the hundred numbers that a grid's arrays consist of.
@njit(cache=True, nogil=True, inline="always")
def _look_up(grid, ix, iy, iz, block, cells, lane):  # type: ignore[no-untyped-def]
    """Write a block, its row, and its cells into a lane."""
    row = find_block(grid.table, ix, iy, iz)
    size, records, absent = np.float32(grid.block_size), grid.records, grid.records.shape[0] - 1
    block[0], block[1], block[2], block[3] = ix, iy, iz, row
    for k in range(8):
        start = np.uintp(k * _VALUES * LANES + lane)
        cell = grid.cells[row, k] if row >= 0 else -1
        c = np.uintp(cell if cell >= 0 else absent)
        cells[start] = records[c, np.uintp(0)] - size * np.float32(k & 1)
        cells[start + _ROW] = records[c, np.uintp(1)] - size * np.float32((k >> 1) & 1)
        cells[start + _ROW * np.uintp(2)] = records[c, np.uintp(2)] - size * np.float32(k >> 2)
        cells[start + _ROW * np.uintp(3)] = records[c, np.uintp(3)]
        cells[start + _ROW * np.uintp(4)] = records[c, np.uintp(4)]
        cells[start + _ROW * np.uintp(5)] = records[c, np.uintp(5)]
        cells[start + _ROW * np.uintp(6)] = records[c, np.uintp(6)]
        cells[start + _ROW * np.uintp(7)] = records[c, np.uintp(7)]
        cells[start + _ROW * np.uintp(8)] = records[c, np.uintp(8)]


@in_place()
def _set_absent(cells: Float32Array, start: int) -> None:
    """Move a cell far off, and set the rest, which may be the memory's first contents, to numbers."""
    for j in range(_VALUES):
        cells[start + _ROW * np.uintp(j)] = _ZERO
    cells[start], cells[start + _ROW * np.uintp(3)] = ABSENT, _ONE


# Sums may be reordered, which vectorising takes, but products not fused with them: a copy of this compiled into another
# kernel would then round otherwise than one from the cache.
@in_place(fastmath={"reassoc"})
def sum_over_cells(cells: Float32Array, place: Float32Array, sums: Float32Array) -> None:
    """Sums over the eight cells of ``w = exp(-1/2 q' B q)``, ``w B q`` (3), ``w B`` (6) and ``w B q q' B`` (6)."""
    sums[:] = _ZERO
    for k in range(8):
        o = k * _VALUES * LANES
        for j in range(LANES):
            qx, qy, qz = (
                place[j] - cells[o + j],
                place[LANES + j] - cells[o + LANES + j],
                place[2 * LANES + j] - cells[o + 2 * LANES + j],
            )
            b0, b1, b2 = cells[o + 3 * LANES + j], cells[o + 4 * LANES + j], cells[o + 5 * LANES + j]
            b3, b4, b5 = cells[o + 6 * LANES + j], cells[o + 7 * LANES + j], cells[o + 8 * LANES + j]
            ux = b0 * qx + b1 * qy + b2 * qz
            uy = b1 * qx + b3 * qy + b4 * qz
            uz = b2 * qx + b4 * qy + b5 * qz
            e = bell(_HALF * (qx * ux + qy * uy + qz * uz))
            ex, ey, ez = e * ux, e * uy, e * uz
            sums[j] += e
            sums[LANES + j] += ex
            sums[2 * LANES + j] += ey
            sums[3 * LANES + j] += ez
            sums[4 * LANES + j] += e * b0
            sums[5 * LANES + j] += e * b1
            sums[6 * LANES + j] += e * b2
            sums[7 * LANES + j] += e * b3
            sums[8 * LANES + j] += e * b4
            sums[9 * LANES + j] += e * b5
            sums[10 * LANES + j] += ex * ux
            sums[11 * LANES + j] += ex * uy
            sums[12 * LANES + j] += ex * uz
            sums[13 * LANES + j] += ey * uy
            sums[14 * LANES + j] += ey * uz
            sums[15 * LANES + j] += ez * uz


@njit(cache=True, nogil=True, inline="always")
def exponent_in_cell(cells, k, place, j):  # type: ignore[no-untyped-def]
    """``1/2 q' B q`` of a lane in its cell ``k``."""
    o = k * _VALUES * LANES + j
    x, y, z = place[j] - cells[o], place[LANES + j] - cells[o + LANES], place[2 * LANES + j] - cells[o + 2 * LANES]
    b0, b1, b2 = cells[o + 3 * LANES], cells[o + 4 * LANES], cells[o + 5 * LANES]
    b3, b4, b5 = cells[o + 6 * LANES], cells[o + 7 * LANES], cells[o + 8 * LANES]
    ux, uy, uz = b0 * x + b1 * y + b2 * z, b1 * x + b3 * y + b4 * z, b2 * x + b4 * y + b5 * z
    return _HALF * (x * ux + y * uy + z * uz)


@in_place(fastmath={"reassoc"})
def mean_over_cells(cells: Float32Array, place: Float32Array, sums: Float32Array) -> None:
    """Mean of ``exp(-1/2 q' B q)`` over the cells that are there, into the first row of ``sums``; -1 where none is."""
    sums[: 2 * LANES] = _ZERO
    for k in range(8):
        for j in range(LANES):
            sums[j] += bell(exponent_in_cell(cells, k, place, j))
            sums[LANES + j] += _ONE if cells[k * _VALUES * LANES + j] < ABSENT else _ZERO
    for j in range(LANES):
        cells_there = sums[LANES + j]
        sums[j] = sums[j] / max(cells_there, _ONE) if cells_there > _ZERO else -_ONE


@njit(cache=True, nogil=True, inline="always")
def bell(exponent):  # type: ignore[no-untyped-def]
    """``exp(-exponent)``, 0 from ``FAR`` on: a power of 16 of a Taylor series, which the compiler vectorises."""
    t = min(exponent, FAR) * _SIXTEENTH
    e = _ONE + t * (_ONE + t * (_HALF + t * (_C3 + t * (_C4 + t * (_C5 + t * _C6)))))
    e *= e
    e *= e
    e *= e
    e *= e
    return e if exponent < FAR else _ZERO


@in_place(fastmath={"reassoc"})
def add_curvature(p: Float32Array, sums: Float32Array, row: int, factor: float, H: FloatArray) -> None:
    """Add ``factor J' B J``, ``J = [I, -[p]x]``, of all lanes to the upper triangle of H; B: six rows from ``row``."""
    o = row * LANES
    sxx = sxy = sxz = syy = syz = szz = _ZERO
    ax = ay = az = bx = by = bz = cx = cy = cz = _ZERO
    rxx = rxy = rxz = ryy = ryz = rzz = _ZERO
    for j in range(LANES):
        px, py, pz = p[j], p[LANES + j], p[2 * LANES + j]
        xx, xy, xz = sums[o + j], sums[o + LANES + j], sums[o + 2 * LANES + j]
        yy, yz, zz = sums[o + 3 * LANES + j], sums[o + 4 * LANES + j], sums[o + 5 * LANES + j]
        # rows of [p]x B: p x (column of B)
        ux, uy, uz = py * xz - pz * xy, pz * xx - px * xz, px * xy - py * xx
        vx, vy, vz = py * yz - pz * yy, pz * xy - px * yz, px * yy - py * xy
        wx, wy, wz = py * zz - pz * yz, pz * xz - px * zz, px * yz - py * xz
        sxx += xx
        sxy += xy
        sxz += xz
        syy += yy
        syz += yz
        szz += zz
        ax += ux
        ay += uy
        az += uz
        bx += vx
        by += vy
        bz += vz
        cx += wx
        cy += wy
        cz += wz
        rxx += py * wx - pz * vx
        rxy += py * wy - pz * vy
        rxz += py * wz - pz * vz
        ryy += pz * uy - px * wy
        ryz += pz * uz - px * wz
        rzz += px * vz - py * uz
    H[0, 0] += factor * sxx
    H[0, 1] += factor * sxy
    H[0, 2] += factor * sxz
    H[1, 1] += factor * syy
    H[1, 2] += factor * syz
    H[2, 2] += factor * szz
    H[0, 3] += factor * ax
    H[0, 4] += factor * ay
    H[0, 5] += factor * az
    H[1, 3] += factor * bx
    H[1, 4] += factor * by
    H[1, 5] += factor * bz
    H[2, 3] += factor * cx
    H[2, 4] += factor * cy
    H[2, 5] += factor * cz
    H[3, 3] += factor * rxx
    H[3, 4] += factor * rxy
    H[3, 5] += factor * rxz
    H[4, 4] += factor * ryy
    H[4, 5] += factor * ryz
    H[5, 5] += factor * rzz


@in_place(fastmath={"reassoc"})
def add_slope(p: Float32Array, sums: Float32Array, factor: float, gradient: FloatArray, H: FloatArray) -> float:
    """Add the lanes' gradient, and what the bend of their rotation makes of it in the Hessian; returns the sum of w.

    v . d2x'/dw_i dw_j = (p_i v_j + p_j v_i) / 2 - delta_ij (p . v)
    """
    w = gx = gy = gz = hx = hy = hz = rx = ry = rz = bxy = bxz = byz = _ZERO
    for j in range(LANES):
        px, py, pz = p[j], p[LANES + j], p[2 * LANES + j]
        vx, vy, vz = sums[LANES + j], sums[2 * LANES + j], sums[3 * LANES + j]
        xx, yy, zz = px * vx, py * vy, pz * vz
        xy, yx, xz, zx, yz, zy = px * vy, py * vx, px * vz, pz * vx, py * vz, pz * vy
        w += sums[j]
        gx += vx
        gy += vy
        gz += vz
        rx += yz - zy
        ry += zx - xz
        rz += xy - yx
        hx += yy + zz
        hy += xx + zz
        hz += xx + yy
        bxy += xy + yx
        bxz += xz + zx
        byz += yz + zy
    gradient[0] += factor * gx
    gradient[1] += factor * gy
    gradient[2] += factor * gz
    gradient[3] += factor * rx
    gradient[4] += factor * ry
    gradient[5] += factor * rz
    H[3, 3] -= factor * hx
    H[4, 4] -= factor * hy
    H[5, 5] -= factor * hz
    H[3, 4] += 0.5 * factor * bxy
    H[3, 5] += 0.5 * factor * bxz
    H[4, 5] += 0.5 * factor * byz
    return float(factor * w)


@in_place()
def take_off_squares(sums: Float32Array) -> None:
    """Turn ``w B`` into ``w B - w B q q' B``."""
    for j in range(6 * LANES):
        sums[4 * LANES + j] -= sums[10 * LANES + j]
