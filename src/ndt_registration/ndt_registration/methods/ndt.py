# SPDX-License-Identifier: Apache-2.0
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

from ndt_registration.clouds.eigen import cholesky_solve6
from ndt_registration.clouds.voxel_grid import NormalGrid
from ndt_registration.methods.lanes import (
    Neighbours,
    add_curvature,
    add_slope,
    gather,
    groups_of,
    no_neighbours,
    sum_over_cells,
    take_off_squares,
)
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place


class Layer(NamedTuple):
    """One kind of points (n, 3) and the grid of the same kind that they are matched with; ``factor`` weighs them."""

    points: FloatArray
    grid: NormalGrid
    factor: float


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


@in_place()
def ndt_derivatives(
    layer: Layer,
    R: FloatArray,
    t: FloatArray,
    at: Neighbours,
    first: int,
    gradient: FloatArray,
    hessian: FloatArray,
    majorant: FloatArray,
) -> float:
    """Cost ``-factor sum exp(...) / 8`` of a layer's points at a pose; adds to its gradient (6,), Hessian and majorant.

    ``at`` is kept from one evaluation to the next, with those of this layer from group ``first`` on. The majorant is
    the positive semidefinite part (that of iteratively reweighted least squares): a step with it always lowers the
    cost, also where the Hessian is indefinite.
    """
    factor, sums = 0.125 * layer.factor, at.sums
    cost = 0.0
    for group in range(groups_of(layer.points.shape[0])):
        gather(layer.points, group, layer.grid, R, t, at, first)
        sum_over_cells(at.cells[first + group], at.place, sums)
        add_curvature(at.turned, sums, 4, factor, majorant)
        take_off_squares(sums)
        add_curvature(at.turned, sums, 4, factor, hessian)
        cost -= add_slope(at.turned, sums, factor, gradient, hessian)
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
        first += groups_of(layer.points.shape[0])
    for r in range(6):
        for c in range(r):
            hessian[r, c] = hessian[c, r]
            majorant[r, c] = majorant[c, r]
    return cost


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
    groups = 0
    for layer in layers:
        groups += groups_of(layer.points.shape[0])
    neighbours = no_neighbours(groups)
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
