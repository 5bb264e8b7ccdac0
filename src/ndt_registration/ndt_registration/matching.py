# SPDX-License-Identifier: Apache-2.0
"""Fit of a moved cloud to the cells of another: inliers, their distances, gradients of the cost by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ndt_registration.ndt import Layer
from ndt_registration.voxel_grid import NormalGrid, find_block
from slam_core.geometry import FloatArray
from slam_core.in_place import in_place

_MATCHED = 4.5
"""A point with an exponent below this (three standard deviations) lies on a surface of the target."""


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


@njit(cache=True, nogil=True, inline="always")
def _add_moments(px, py, pz, weight, sums):  # type: ignore[no-untyped-def]
    """Add a point's weight and its weighted first and second moments to ``sums`` (10,)."""
    x, y, z = weight * px, weight * py, weight * pz
    sums[0] += weight
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * px
    sums[5] += x * py
    sums[6] += x * pz
    sums[7] += y * py
    sums[8] += y * pz
    sums[9] += z * pz


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


@njit(cache=True, nogil=True, inline="always")
def _offset(grid, cell, x, y, z):  # type: ignore[no-untyped-def]
    """Offset q of a point from a cell's mean, and the cell's information times q."""
    qx, qy, qz = x - grid.mean[cell, 0], y - grid.mean[cell, 1], z - grid.mean[cell, 2]
    b = grid.information[cell]
    ux = b[0] * qx + b[1] * qy + b[2] * qz
    uy = b[1] * qx + b[3] * qy + b[4] * qz
    uz = b[2] * qx + b[4] * qy + b[5] * qz
    return qx, qy, qz, ux, uy, uz


@njit(cache=True, nogil=True)
def fit_to_grid(points: FloatArray, R: FloatArray, t: FloatArray, grid: NormalGrid, max_distance: float) -> Fit:
    """Fit of points (n, 3) at a pose.

    A point is an inlier within 3 sigma of its nearest cell and ``max_distance`` m of its plane.
    """
    hessian_moments, majorant_moments = np.zeros(10), np.zeros(10)
    inliers, squares, cx, cy, cz, second = _sums_of_fit(
        points, R, t, grid, max_distance, hessian_moments, majorant_moments
    )
    centre = np.array([cx, cy, cz]) / max(inliers, 1)
    radius = np.sqrt(max(second / max(inliers, 1) - (centre * centre).sum(), 1e-12))
    return Fit(
        inliers / max(points.shape[0], 1),
        np.sqrt(squares / max(inliers, 1)),
        centre,
        radius,
        _hessian_of_weights(hessian_moments),
        _hessian_of_weights(majorant_moments),
    )


@in_place()
def _fit_of_cells(grid, row, mx, my, mz):  # type: ignore[no-untyped-def]
    """Weight of a point in cost, majorant and Hessian; least exponent of its cells and the distance there."""
    weight = majorant_weight = hessian_weight = 0.0
    best, distance = _MATCHED, 0.0
    for k in range(8):
        cell = grid.cells[row, k]
        if cell < 0:
            continue
        qx, qy, qz, ux, uy, uz = _offset(grid, cell, mx, my, mz)
        exponent = 0.5 * (qx * ux + qy * uy + qz * uz)
        e = 0.125 * np.exp(-min(exponent, 30.0))
        weight += e
        # In the plane the least variance is that of z, which is zero, and the second is across the wall.
        flat = grid.variance[cell, 0] <= 1e-9 * grid.variance[cell, 2]
        spread = grid.variance[cell, 2] if flat else grid.variance[cell, 1]
        b = grid.information[cell]
        information = e * min(1.0 / max(grid.counts[cell] * spread, 1e-300), b[0] + b[3] + b[5])
        majorant_weight += information
        hessian_weight += information * (1.0 - 2.0 * min(exponent, 30.0))
        if exponent < best:
            best = exponent
            distance = abs(qx * grid.normal[cell, 0] + qy * grid.normal[cell, 1] + qz * grid.normal[cell, 2])
    return weight, majorant_weight, hessian_weight, best, distance


@in_place()
def _sums_of_fit(points, R, t, grid, max_distance, hessian_moments, majorant_moments):  # type: ignore[no-untyped-def]
    """Number of inliers, the sum of their squared distances, of their coordinates (three) and of these squared.

    Adds to the moments (10,) of both weights.
    """
    inliers = 0
    squares = 0.0
    cx = cy = cz = second = 0.0
    for i in range(points.shape[0]):
        px = R[0, 0] * points[i, 0] + R[0, 1] * points[i, 1] + R[0, 2] * points[i, 2]
        py = R[1, 0] * points[i, 0] + R[1, 1] * points[i, 1] + R[1, 2] * points[i, 2]
        pz = R[2, 0] * points[i, 0] + R[2, 1] * points[i, 1] + R[2, 2] * points[i, 2]
        mx, my, mz = px + t[0], py + t[1], pz + t[2]
        s = 1.0 / grid.block_size
        row = find_block(grid.keys, grid.rows, int(np.floor(mx * s)), int(np.floor(my * s)), int(np.floor(mz * s)))
        if row < 0:
            continue
        weight, majorant_weight, hessian_weight, best, distance = _fit_of_cells(grid, row, mx, my, mz)
        if best < _MATCHED and distance < max_distance:
            inliers += 1
            squares += distance * distance
            cx += px
            cy += py
            cz += pz
            second += px * px + py * py + pz * pz
        if weight == 0.0:
            continue
        _add_moments(px, py, pz, majorant_weight, majorant_moments)
        _add_moments(px, py, pz, hessian_weight, hessian_moments)
    return inliers, squares, cx, cy, cz, second


@njit(cache=True, nogil=True)
def block_gradients(layer: Layer, R: FloatArray, t: FloatArray) -> FloatArray:
    """Gradient (b, 6) of the cost of one layer at a pose, summed over each of the grid's blocks, half a cell's edge."""
    blocks = layer.grid.cells.shape[0]
    gradients, touched = np.zeros((blocks, 6)), np.zeros(blocks, np.bool_)
    _add_gradients(layer, R, t, gradients, touched)
    return gradients[touched]


@in_place()
def _add_gradients(layer, R, t, gradients, touched):  # type: ignore[no-untyped-def]
    """Add to the gradients (b, 6) of all blocks, and mark those that hold points."""
    grid = layer.grid
    s = 1.0 / grid.block_size
    for i in range(layer.points.shape[0]):
        x, y, z = layer.points[i, 0], layer.points[i, 1], layer.points[i, 2]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        mx, my, mz = px + t[0], py + t[1], pz + t[2]
        row = find_block(grid.keys, grid.rows, int(np.floor(mx * s)), int(np.floor(my * s)), int(np.floor(mz * s)))
        if row < 0:
            continue
        vx = vy = vz = 0.0
        for k in range(8):
            cell = grid.cells[row, k]
            if cell < 0:
                continue
            qx, qy, qz, ux, uy, uz = _offset(grid, cell, mx, my, mz)
            e = 0.125 * layer.factor * np.exp(-min(0.5 * (qx * ux + qy * uy + qz * uz), 30.0))
            vx += e * ux
            vy += e * uy
            vz += e * uz
        touched[row] = True
        gradients[row, 0] += vx
        gradients[row, 1] += vy
        gradients[row, 2] += vz
        gradients[row, 3] += py * vz - pz * vy
        gradients[row, 4] += pz * vx - px * vz
        gradients[row, 5] += px * vy - py * vx
