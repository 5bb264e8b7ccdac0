"""Normal Distributions Transform: score, exact gradient and Hessian, and the damped Newton ascent (thesis 8.2, 10.5).

The score of a pose is the sum over points ``x`` and over the cells that cover the moved point ``x' = R x + t`` of
``exp(-1/2 q' B q)``, ``q = x' - mean``, ``B`` the cell's information (Eq. 8.5). The pose error is that of
``slam_core.geometry``: translation first, both halves along the target's axes. With ``p = R x``:

    dx'/d(translation) = I,   dx'/d(rotation) = -[p]x,   d2x'/dw_i dw_j = (e_i x (e_j x p) + e_j x (e_i x p)) / 2

so gradient and Hessian (Eqs. 8.6-8.7) are exact, the second-order terms included.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ndt_registration.eigen import cholesky_solve6
from ndt_registration.voxel_grid import NormalGrid, find_block
from slam_core.geometry import FloatArray


class Layer(NamedTuple):
    """One kind of points (n, 3) and the grid of the same kind that they are matched with; ``factor`` weighs them."""

    points: FloatArray
    grid: NormalGrid
    factor: float


class NdtOptimum(NamedTuple):
    """Pose, mean score per point in [0, 1], iterations, whether the step became small; derivatives of the *cost*
    (-score, summed over the points), and how many points.
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
def ndt_derivatives(
    points: FloatArray,
    R: FloatArray,
    t: FloatArray,
    grid: NormalGrid,
    factor: float,
    gradient: FloatArray,
    hessian: FloatArray,
    majorant: FloatArray,
) -> float:
    """Cost ``-factor sum exp(...) / 8`` of points (n, 3) at the pose; adds to its gradient (6,), Hessian and majorant
    (6, 6).

    The majorant is the positive semidefinite part (that of iteratively reweighted least squares): a step with it always
    lowers the cost, also where the Hessian is indefinite.
    """
    inverse_size = 1.0 / grid.block_size
    cost = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        mx, my, mz = px + t[0], py + t[1], pz + t[2]
        row = find_block(
            grid.keys,
            grid.rows,
            int(np.floor(mx * inverse_size)),
            int(np.floor(my * inverse_size)),
            int(np.floor(mz * inverse_size)),
        )
        if row < 0:
            continue
        weight = 0.0
        vx = vy = vz = 0.0
        bxx = bxy = bxz = byy = byz = bzz = 0.0
        sxx = sxy = sxz = syy = syz = szz = 0.0
        for k in range(8):
            cell = grid.cells[row, k]
            if cell < 0:
                continue
            qx, qy, qz = mx - grid.mean[cell, 0], my - grid.mean[cell, 1], mz - grid.mean[cell, 2]
            b0, b1, b2 = grid.information[cell, 0], grid.information[cell, 1], grid.information[cell, 2]
            b3, b4, b5 = grid.information[cell, 3], grid.information[cell, 4], grid.information[cell, 5]
            ux = b0 * qx + b1 * qy + b2 * qz
            uy = b1 * qx + b3 * qy + b4 * qz
            uz = b2 * qx + b4 * qy + b5 * qz
            exponent = 0.5 * (qx * ux + qy * uy + qz * uz)
            if exponent > 20.0:
                continue
            e = 0.125 * factor * np.exp(-exponent)
            weight += e
            vx += e * ux
            vy += e * uy
            vz += e * uz
            bxx += e * b0
            bxy += e * b1
            bxz += e * b2
            byy += e * b3
            byz += e * b4
            bzz += e * b5
            sxx += e * ux * ux
            sxy += e * ux * uy
            sxz += e * ux * uz
            syy += e * uy * uy
            syz += e * uy * uz
            szz += e * uz * uz
        if weight == 0.0:
            continue
        cost -= weight
        _add_point(px, py, pz, vx, vy, vz, bxx, bxy, bxz, byy, byz, bzz, majorant)
        _add_point(
            px, py, pz, vx, vy, vz,
            bxx - sxx, bxy - sxy, bxz - sxz, byy - syy, byz - syz, bzz - szz, hessian,
        )  # fmt: skip
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
    return cost


@njit(cache=True, nogil=True)
def cost_and_derivatives(
    layers: tuple[Layer, ...],
    R: FloatArray,
    t: FloatArray,
    gradient: FloatArray,
    hessian: FloatArray,
    majorant: FloatArray,
) -> float:
    """Cost of all layers at a pose; writes its derivatives."""
    gradient[:], hessian[:], majorant[:] = 0.0, 0.0, 0.0
    cost = 0.0
    for layer in layers:
        cost += ndt_derivatives(layer.points, R, t, layer.grid, layer.factor, gradient, hessian, majorant)
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
    cost = cost_and_derivatives(layers, R, t, g, H, M)
    step = np.zeros(6)
    scale = np.array([1.0, 1.0, 1.0, lever * lever, lever * lever, lever * lever])
    damping = 1e-6
    max_step = 2.0 * layers[0].grid.block_size
    converged = False
    iteration = 0
    while iteration < max_iterations and cost < 0.0:
        iteration += 1
        curvature = 0.0
        for k in range(3):
            curvature = max(curvature, M[k, k])
        penalty = scale * (damping * curvature + 1e-300) + fixed * (1e12 * curvature + 1e-300) * scale
        newton = cholesky_solve6(H, penalty, g, step)
        if not newton and not cholesky_solve6(M, penalty + 1e-9 * curvature * scale, g, step):
            damping = max(10.0 * damping, 1e-6)
            continue
        size = np.sqrt((step * step * scale).sum())
        if size > max_step:
            step *= max_step / size
        R_new = _rotated(R, step[3:])
        t_new = t + step[:3]
        cost_new = cost_and_derivatives(layers, R_new, t_new, g_new, H_new, M_new)
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
