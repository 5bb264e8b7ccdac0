# SPDX-License-Identifier: Apache-2.0
"""Normal Distributions Transform: score, exact gradient and Hessian, and the damped Newton ascent (thesis 8.2, 10.5).

The score of a pose is the sum over points ``x`` and over the cells that cover the moved point ``x' = R x + t`` of
``exp(-1/2 q' B q)``, ``q = x' - mean``, ``B`` the cell's information (Eq. 8.5). The pose error is that of
``slam_core.geometry``: translation first, both halves along the target's axes. With ``p = R x``:

    dx'/d(translation) = I,   dx'/d(rotation) = -[p]x,   d2x'/dw_i dw_j = (e_i x (e_j x p) + e_j x (e_i x p)) / 2

so gradient and Hessian (Eqs. 8.6-8.7) are exact, the second-order terms included.

From one step to the next most points stay in their block, so each keeps a copy of the eight cells around it, number by
number beside each other: the next evaluation neither looks them up nor gathers them, and computes all eight at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.eigen import cholesky_solve6
from ndt_registration.voxel_grid import NormalGrid, find_block
from slam_core.geometry import FloatArray
from slam_core.in_place import in_place

Int32Array = npt.NDArray[np.int32]

_NOWHERE = -(2**31)
"""Coordinate that no block has."""
_FAR = 20.0
"""Half a squared Mahalanobis distance beyond which a cell does not count."""


class Layer(NamedTuple):
    """One kind of points (n, 3) and the grid of the same kind that they are matched with; ``factor`` weighs them."""

    points: FloatArray
    grid: NormalGrid
    factor: float


class Neighbours(NamedTuple):
    """Cells around each of n points, from the last evaluation.

    block (n, 4): integer coordinates of the block and its row in the grid, -1 where there is none. cells (n, 10, 8):
    mean from the block's corner (3), information (6) and 1 for each of eight cells, 0 where there is none. sums (16,):
    room for those of one point.
    """

    block: Int32Array
    cells: FloatArray
    sums: FloatArray


class NdtOptimum(NamedTuple):
    """Pose, mean score per point in [0, 1], iterations, whether the step became small.

    Derivatives of the *cost* (-score, summed over the points), and how many points.
    """

    rotation: FloatArray
    translation: FloatArray
    score: float
    iterations: int
    converged: bool
    gradient: FloatArray
    hessian: FloatArray
    majorant: FloatArray
    points: int


@njit(cache=True, nogil=True)
def no_neighbours(points: int) -> Neighbours:
    """Room for so many points, none of them looked up yet."""
    return Neighbours(np.full((points, 4), _NOWHERE, np.int32), np.empty((points, 10, 8)), np.empty(16))


@in_place()
def _look_up(grid: NormalGrid, ix: int, iy: int, iz: int, block: Int32Array, cells: FloatArray) -> None:
    """Write a block, its row and its cells."""
    row = find_block(grid.keys, grid.rows, ix, iy, iz)
    block[0], block[1], block[2], block[3] = ix, iy, iz, row
    if row < 0:
        return
    for k in range(8):
        cell = grid.cells[row, k]
        if cell < 0:
            for j in range(10):
                cells[j, k] = 0.0
            continue
        cells[0, k] = grid.mean[cell, 0] - ix * grid.block_size
        cells[1, k] = grid.mean[cell, 1] - iy * grid.block_size
        cells[2, k] = grid.mean[cell, 2] - iz * grid.block_size
        for j in range(6):
            cells[3 + j, k] = grid.information[cell, j]
        cells[9, k] = 1.0


# Sums may be reordered, which vectorising takes, but products not fused with them: a copy of this compiled into another
# kernel would then round otherwise than one from the cache.
@in_place(fastmath={"reassoc"})
def _sum_over_cells(cells: FloatArray, x: float, y: float, z: float, factor: float, out: FloatArray) -> None:
    """Sums over eight cells of ``w = factor exp(-1/2 q' B q)``, ``w B q``, ``w B`` and ``w B q q' B``, out (16,)."""
    w = vx = vy = vz = bxx = bxy = bxz = byy = byz = bzz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for k in range(8):
        qx, qy, qz = x - cells[0, k], y - cells[1, k], z - cells[2, k]
        b0, b1, b2, b3, b4, b5 = cells[3, k], cells[4, k], cells[5, k], cells[6, k], cells[7, k], cells[8, k]
        ux = b0 * qx + b1 * qy + b2 * qz
        uy = b1 * qx + b3 * qy + b4 * qz
        uz = b2 * qx + b4 * qy + b5 * qz
        exponent = 0.5 * (qx * ux + qy * uy + qz * uz)
        # exp(-exponent) as a power of 16 of its Taylor series: products alone, which the compiler vectorises.
        t = min(exponent, _FAR) * (-1.0 / 16.0)
        e = t * (1 / 120 + t * (1 / 720 + t * (1 / 5040 + t * (1 / 40320))))
        e = 1.0 + t * (1.0 + t * (1 / 2 + t * (1 / 6 + t * (1 / 24 + e))))
        e *= e
        e *= e
        e *= e
        e *= e
        e = factor * e * cells[9, k] if exponent < _FAR else 0.0
        ex, ey, ez = e * ux, e * uy, e * uz
        w += e
        vx += ex
        vy += ey
        vz += ez
        bxx += e * b0
        bxy += e * b1
        bxz += e * b2
        byy += e * b3
        byz += e * b4
        bzz += e * b5
        sxx += ex * ux
        sxy += ex * uy
        sxz += ex * uz
        syy += ey * uy
        syz += ey * uz
        szz += ez * uz
    out[0], out[1], out[2], out[3] = w, vx, vy, vz
    out[4], out[5], out[6], out[7], out[8], out[9] = bxx, bxy, bxz, byy, byz, bzz
    out[10], out[11], out[12], out[13], out[14], out[15] = sxx, sxy, sxz, syy, syz, szz


@in_place()
def _add_slope(
    px: float, py: float, pz: float, vx: float, vy: float, vz: float, gradient: FloatArray, hessian: FloatArray
) -> None:
    """Add one point's part of the gradient, and what the bend of its rotation makes of it in the Hessian."""
    gradient[0] += vx
    gradient[1] += vy
    gradient[2] += vz
    gradient[3] += py * vz - pz * vy
    gradient[4] += pz * vx - px * vz
    gradient[5] += px * vy - py * vx
    # v . d2x'/dw_i dw_j = (p_i v_j + p_j v_i) / 2 - delta_ij (p . v)
    dot = px * vx + py * vy + pz * vz
    hessian[3, 3] += px * vx - dot
    hessian[4, 4] += py * vy - dot
    hessian[5, 5] += pz * vz - dot
    hessian[3, 4] += 0.5 * (px * vy + py * vx)
    hessian[3, 5] += 0.5 * (px * vz + pz * vx)
    hessian[4, 5] += 0.5 * (py * vz + pz * vy)


@in_place()
def ndt_derivatives(
    layer: Layer,
    R: FloatArray,
    t: FloatArray,
    neighbours: Neighbours,
    first: int,
    gradient: FloatArray,
    hessian: FloatArray,
    majorant: FloatArray,
) -> float:
    """Cost ``-factor sum exp(...) / 8`` of a layer's points at a pose; adds to its gradient (6,), Hessian and majorant.

    ``neighbours`` are kept from one evaluation to the next, those of this layer from row ``first`` on. The majorant is
    the positive semidefinite part (that of iteratively reweighted least squares): a step with it always lowers the
    cost, also where the Hessian is indefinite.
    """
    points, size = layer.points, layer.grid.block_size
    inverse_size, factor = 1.0 / size, 0.125 * layer.factor
    sums = neighbours.sums
    cost = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        mx, my, mz = px + t[0], py + t[1], pz + t[2]
        ix, iy = int(np.floor(mx * inverse_size)), int(np.floor(my * inverse_size))
        iz = int(np.floor(mz * inverse_size))
        block, cells = neighbours.block[first + i], neighbours.cells[first + i]
        if block[0] != ix or block[1] != iy or block[2] != iz:
            _look_up(layer.grid, ix, iy, iz, block, cells)
        if block[3] < 0:
            continue
        _sum_over_cells(cells, mx - ix * size, my - iy * size, mz - iz * size, factor, sums)
        if sums[0] == 0.0:
            continue
        cost -= sums[0]
        vx, vy, vz = sums[1], sums[2], sums[3]
        bxx, bxy, bxz, byy, byz, bzz = sums[4], sums[5], sums[6], sums[7], sums[8], sums[9]
        _add_point(px, py, pz, vx, vy, vz, bxx, bxy, bxz, byy, byz, bzz, majorant)
        _add_point(
            px, py, pz, vx, vy, vz,
            bxx - sums[10], bxy - sums[11], bxz - sums[12], byy - sums[13], byz - sums[14], bzz - sums[15], hessian,
        )  # fmt: skip
        _add_slope(px, py, pz, vx, vy, vz, gradient, hessian)
    return cost


@in_place()
def cost_and_derivatives(
    layers: tuple[Layer, ...],
    R: FloatArray,
    t: FloatArray,
    neighbours: Neighbours,
    gradient: FloatArray,
    hessian: FloatArray,
    majorant: FloatArray,
) -> float:
    """Cost of all layers at a pose; writes its derivatives."""
    gradient[:], hessian[:], majorant[:] = 0.0, 0.0, 0.0
    cost, first = 0.0, 0
    for layer in layers:
        cost += ndt_derivatives(layer, R, t, neighbours, first, gradient, hessian, majorant)
        first += layer.points.shape[0]
    for r in range(6):
        for c in range(r):
            hessian[r, c] = hessian[c, r]
            majorant[r, c] = majorant[c, r]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _add_point(px, py, pz, vx, vy, vz, xx, xy, xz, yy, yz, zz, H):  # type: ignore[no-untyped-def]
    """Add ``J' B J`` with ``J = [I, -[p]x]`` to the upper triangle of H."""
    H[0, 0] += xx
    H[0, 1] += xy
    H[0, 2] += xz
    H[1, 1] += yy
    H[1, 2] += yz
    H[2, 2] += zz
    # rows of [p]x B: r_i = p x (column i of B)
    ax, ay, az = py * xz - pz * xy, pz * xx - px * xz, px * xy - py * xx
    bx, by, bz = py * yz - pz * yy, pz * xy - px * yz, px * yy - py * xy
    cx, cy, cz = py * zz - pz * yz, pz * xz - px * zz, px * yz - py * xz
    H[0, 3] += ax
    H[0, 4] += ay
    H[0, 5] += az
    H[1, 3] += bx
    H[1, 4] += by
    H[1, 5] += bz
    H[2, 3] += cx
    H[2, 4] += cy
    H[2, 5] += cz
    H[3, 3] += py * cx - pz * bx
    H[3, 4] += py * cy - pz * by
    H[3, 5] += py * cz - pz * bz
    H[4, 4] += pz * ay - px * cy
    H[4, 5] += pz * az - px * cz
    H[5, 5] += px * bz - py * az


@njit(cache=True, nogil=True)
def _rotated(R: FloatArray, w: FloatArray) -> FloatArray:
    """``Exp(w) R``."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if angle < 1e-12:
        return R.copy()
    kx, ky, kz = w[0] / angle, w[1] / angle, w[2] / angle
    s, c = np.sin(angle), 1.0 - np.cos(angle)
    E = np.empty((3, 3))
    E[0, 0], E[0, 1], E[0, 2] = 1.0 - c * (ky * ky + kz * kz), c * kx * ky - s * kz, c * kx * kz + s * ky
    E[1, 0], E[1, 1], E[1, 2] = c * kx * ky + s * kz, 1.0 - c * (kx * kx + kz * kz), c * ky * kz - s * kx
    E[2, 0], E[2, 1], E[2, 2] = c * kx * kz - s * ky, c * ky * kz + s * kx, 1.0 - c * (kx * kx + ky * ky)
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += E[i, k] * R[k, j]
    return out


@njit(cache=True, nogil=True)
def _damped_step(
    H: FloatArray, M: FloatArray, g: FloatArray, scale: FloatArray, fixed: FloatArray, damping: float, step: FloatArray
) -> tuple[bool, bool]:
    """Fill ``step`` (6,); True if there is one, and True if it is Newton's, not the majorant's."""
    curvature = 0.0
    for k in range(3):
        curvature = max(curvature, M[k, k])
    penalty = scale * (damping * curvature + 1e-300) + fixed * (1e12 * curvature + 1e-300) * scale
    newton = cholesky_solve6(H, penalty, g, step)
    return newton or cholesky_solve6(M, penalty + 1e-9 * curvature * scale, g, step), newton


@njit(cache=True, nogil=True)
def ndt_align(
    layers: tuple[Layer, ...],
    rotation: FloatArray,
    translation: FloatArray,
    fixed: FloatArray,
    lever: float,
    max_iterations: int,
    tolerance: float,
) -> NdtOptimum:
    """Damped Newton descent of the NDT cost from a pose.

    Parameters
    ----------
    layers
        Surfaces and rims, each with source points and target grid; the first gives scale to steps and score.
    rotation, translation
        Initial T_target_source.
    fixed
        Shape (6,): 1 where a component of the pose error is held (the planar case), else 0.
    lever
        Typical distance of the points, m: makes an angle comparable with a length in the damping and in the tolerance.
    max_iterations, tolerance
        Ends when a step is shorter than ``tolerance`` m (angles times ``lever``).

    Steps use the exact Hessian where it is positive definite and the majorant otherwise (10.5: the Hessian must be made
    positive definite), with Levenberg-Marquardt damping controlled by the ratio of actual to predicted decrease.
    """
    g, H, M = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    g_new, H_new, M_new = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    R, t = rotation.copy(), translation.copy()
    points = 0
    for layer in layers:
        points += layer.points.shape[0]
    neighbours = no_neighbours(points)
    cost = cost_and_derivatives(layers, R, t, neighbours, g, H, M)
    step = np.zeros(6)
    scale = np.array([1.0, 1.0, 1.0, lever * lever, lever * lever, lever * lever])
    damping = 1e-6
    max_step = 2.0 * layers[0].grid.block_size
    converged = False
    iteration = 0
    while iteration < max_iterations and cost < 0.0:
        iteration += 1
        solved, newton = _damped_step(H, M, g, scale, fixed, damping, step)
        if not solved:
            damping = max(10.0 * damping, 1e-6)
            continue
        size = np.sqrt((step * step * scale).sum())
        if size > max_step:
            step *= max_step / size
        R_new = _rotated(R, step[3:])
        t_new = t + step[:3]
        cost_new = cost_and_derivatives(layers, R_new, t_new, neighbours, g_new, H_new, M_new)
        predicted = -(g * step).sum() - 0.5 * (step * ((H if newton else M) @ step)).sum()
        if cost_new < cost or size < tolerance:
            gain = (cost - cost_new) / max(predicted, 1e-300)
            damping = damping * 0.1 if gain > 0.5 else (damping if gain > 0.1 else damping * 4.0)
            damping = max(damping, 1e-9)
            if cost_new < cost:
                R, t, cost = R_new, t_new, cost_new
                g, g_new = g_new, g
                H, H_new = H_new, H
                M, M_new = M_new, M
            if size < tolerance:
                converged = True
                break
        else:
            damping = max(damping * 10.0, 1e-4)
            if damping > 1e8:
                break
    return NdtOptimum(
        R, t, -cost / max(layers[0].points.shape[0], 1), iteration, converged, g, H, M, layers[0].points.shape[0]
    )
