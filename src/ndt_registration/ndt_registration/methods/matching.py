# SPDX-License-Identifier: Apache-2.0
"""Fit of a moved cloud to the cells of another: inliers, their distances, gradients of the cost by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ndt_registration.clouds.block_table import Int32Array
from ndt_registration.clouds.voxel_grid import SPURIOUS, NormalGrid
from ndt_registration.methods.lanes import (
    FAR,
    LANES,
    bell,
    exponent_in_cell,
    gather,
    groups_of,
    no_neighbours,
    sum_over_cells,
)
from ndt_registration.methods.ndt import Layer
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

_MATCHED = np.float32(4.5)
"""A point with an exponent below this (three standard deviations) lies on a surface of the target."""
_FIT_ROWS = 5
_ZERO, _EIGHTH, _ONE, _TWO = np.float32(0.0), np.float32(0.125), np.float32(1.0), np.float32(2.0)


class Fit(NamedTuple):
    """Fit of a cloud to the target's surfaces.

    Share of points on the surfaces, their root mean square distance (m), their centroid (3,) about the target's axes
    and their root mean square distance from it.

    spurious_hessian (6, 6): expected part of the cost's Hessian that errors of the cells' normals alone make;
    spurious_majorant (6, 6): that of its majorant. A normal from ``n`` points is off by ``sqrt(variance / (n
    spread))``, so that a plane seems to hold points along itself with an information of ``1 / (n spread)``, of which
    the Hessian keeps the more the better a point fits.
    """

    overlap: float
    inlier_rmse: float
    centre: FloatArray
    radius: float
    spurious_hessian: FloatArray
    spurious_majorant: FloatArray


@njit(cache=True, nogil=True)
def _hessian_of_weights(sums: FloatArray) -> FloatArray:
    """Sum of ``weight J' J`` with ``J = [I, -[p]x]`` from the weighted moments of the points."""
    s, x, y, z = sums[0], sums[1], sums[2], sums[3]
    xx, xy, xz, yy, yz, zz = sums[4], sums[5], sums[6], sums[7], sums[8], sums[9]
    return np.array(
        [
            [s, 0.0, 0.0, 0.0, z, -y],
            [0.0, s, 0.0, -z, 0.0, x],
            [0.0, 0.0, s, y, -x, 0.0],
            [0.0, -z, y, yy + zz, -xy, -xz],
            [z, 0.0, -x, -xy, xx + zz, -yz],
            [-y, x, 0.0, -xz, -yz, xx + yy],
        ]
    )


@njit(cache=True, nogil=True)
def fit_to_grid(
    points: FloatArray, R: FloatArray, t: FloatArray, grid: NormalGrid, wider: NormalGrid, max_distance: float
) -> Fit:
    """Fit of points (n, 3) at a pose.

    A point is an inlier within 3 sigma of its nearest cell and ``max_distance`` m of its plane. Where the target is so
    thin that the grid has no cell, that of the wider grid decides: no cell is no evidence that there is no surface.
    """
    hessian_moments, majorant_moments, unused = np.zeros(10), np.zeros(10), np.zeros(10)
    room, sums, bare = np.empty((8 + _FIT_ROWS) * LANES, np.float32), np.zeros(6), np.empty(points.shape[0], np.bool_)
    _add_fits(points, R, t, grid, max_distance, no_neighbours(1), room, hessian_moments, majorant_moments, sums, bare)
    rest = points[bare]
    _add_fits(rest, R, t, wider, max_distance, no_neighbours(1), room, unused, unused, sums, bare)
    inliers = max(sums[0], 1.0)
    centre = sums[2:5] / inliers
    radius = np.sqrt(max(sums[5] / inliers - (centre * centre).sum(), 1e-12))
    return Fit(
        sums[0] / max(points.shape[0], 1),
        np.sqrt(sums[1] / inliers),
        centre,
        radius,
        _hessian_of_weights(hessian_moments),
        _hessian_of_weights(majorant_moments),
    )


@in_place(fastmath={"reassoc"})
def _fit_of_cells(cells, place, room):  # type: ignore[no-untyped-def]
    """Fit of each lane: rows of ``room`` from 8 on, whose first eight hold the cells' spurious information.

    Weight in the cost, in the majorant and in the Hessian; least exponent of its cells, and which of them that is.
    """
    for j in range(LANES):
        room[8 * LANES + j] = room[9 * LANES + j] = room[10 * LANES + j] = room[12 * LANES + j] = _ZERO
        room[11 * LANES + j] = _MATCHED
    for k in range(8):
        number = np.float32(k)
        for j in range(LANES):
            exponent = exponent_in_cell(cells, k, place, j)
            e = _EIGHTH * bell(exponent)
            room[8 * LANES + j] += e
            information = e * room[k * LANES + j]
            room[9 * LANES + j] += information
            room[10 * LANES + j] += information * (_ONE - _TWO * min(exponent, FAR))
            best = room[11 * LANES + j]
            room[12 * LANES + j] = number if exponent < best else room[12 * LANES + j]
            room[11 * LANES + j] = exponent if exponent < best else best


@in_place(fastmath={"reassoc"})
def _add_moments(p, weights, row, moments):  # type: ignore[no-untyped-def]
    """Add the lanes' weights, which are a row of an array, and their first and second moments to ``moments`` (10,)."""
    s = x = y = z = xx = xy = xz = yy = yz = zz = _ZERO
    for j in range(LANES):
        w, px, py, pz = weights[row * LANES + j], p[j], p[LANES + j], p[2 * LANES + j]
        wx, wy, wz = w * px, w * py, w * pz
        s += w
        x += wx
        y += wy
        z += wz
        xx += wx * px
        xy += wx * py
        xz += wx * pz
        yy += wy * py
        yz += wy * pz
        zz += wz * pz
    moments[0] += s
    moments[1] += x
    moments[2] += y
    moments[3] += z
    moments[4] += xx
    moments[5] += xy
    moments[6] += xz
    moments[7] += yy
    moments[8] += yz
    moments[9] += zz


@in_place()
def _add_fits(points, R, t, grid, max_distance, at, room, hessian_moments, majorant_moments, sums, bare):  # type: ignore[no-untyped-def]
    """Add to ``sums`` (6,) of the inliers: number, squared distances, coordinates (three) and these squared.

    Adds to the moments (10,) of both weights; ``bare`` (n,) tells the points around which there is no cell.
    """
    for group in range(groups_of(points.shape[0])):
        count = gather(points, group, grid, R, t, at, -group)
        for j in range(LANES):
            row = at.block[j, 3]
            for k in range(8):
                cell = grid.cells[row, k] if row >= 0 else -1
                room[k * LANES + j] = grid.records[cell, SPURIOUS]  # the last where there is none
        _fit_of_cells(at.cells[0], at.place, room)
        _add_moments(at.turned, room, 9, majorant_moments)
        _add_moments(at.turned, room, 10, hessian_moments)
        for j in range(count):
            bare[group * LANES + j] = at.block[j, 3] < 0
            if not room[11 * LANES + j] < _MATCHED:
                continue
            px, py, pz = at.turned[j], at.turned[LANES + j], at.turned[2 * LANES + j]
            distance = _distance(grid, grid.cells[at.block[j, 3], int(room[12 * LANES + j])], px, py, pz, t)
            if distance < max_distance:
                sums[0] += 1.0
                sums[1] += distance * distance
                sums[2] += px
                sums[3] += py
                sums[4] += pz
                sums[5] += px * px + py * py + pz * pz


@in_place()
def _distance(grid, cell, px, py, pz, t):  # type: ignore[no-untyped-def]
    """Distance of a turned point from the plane of a cell."""
    qx, qy, qz = px + t[0] - grid.mean[cell, 0], py + t[1] - grid.mean[cell, 1], pz + t[2] - grid.mean[cell, 2]
    return abs(qx * grid.normal[cell, 0] + qy * grid.normal[cell, 1] + qz * grid.normal[cell, 2])


@njit(cache=True, nogil=True)
def block_gradients(layer: Layer, R: FloatArray, t: FloatArray) -> tuple[FloatArray, Int32Array]:
    """Gradients (b, 6) of a layer's cost at a pose, each of one of the grid's blocks, half a cell's edge.

    And the integer places (b, 3) of these blocks.
    """
    blocks = layer.grid.cells.shape[0]
    gradients, places, touched = np.zeros((blocks, 6)), np.empty((blocks, 3), np.int32), np.zeros(blocks, np.bool_)
    _add_gradients(layer, R, t, no_neighbours(1), gradients, places, touched)
    return gradients[touched], places[touched]


@in_place()
def _add_gradients(layer, R, t, at, gradients, places, touched):  # type: ignore[no-untyped-def]
    """Add to the gradients (b, 6) of all blocks, and mark those that hold points, with their places (b, 3)."""
    factor, sums = 0.125 * layer.factor, at.sums
    for group in range(groups_of(layer.points.shape[0])):
        count = gather(layer.points, group, layer.grid, R, t, at, -group)
        sum_over_cells(at.cells[0], at.place, sums)
        for j in range(count):
            row = at.block[j, 3]
            if row < 0:
                continue
            px, py, pz = at.turned[j], at.turned[LANES + j], at.turned[2 * LANES + j]
            vx, vy, vz = factor * sums[LANES + j], factor * sums[2 * LANES + j], factor * sums[3 * LANES + j]
            touched[row] = True
            places[row, 0], places[row, 1], places[row, 2] = at.block[j, 0], at.block[j, 1], at.block[j, 2]
            gradients[row, 0] += vx
            gradients[row, 1] += vy
            gradients[row, 2] += vz
            gradients[row, 3] += py * vz - pz * vy
            gradients[row, 4] += pz * vx - px * vz
            gradients[row, 5] += px * vy - py * vx
