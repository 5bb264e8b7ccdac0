# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels for pairs of a point and its measurement under a motion.

Errors, covariances, gates, normal equations, and who is paired first.

They are what :func:`ekf_slam_node.filtering.models.observe` and :mod:`ekf_slam_node.filtering.candidates` say in NumPy,
for the loops that run many times per frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from slam_core.camera import MIN_DEPTH
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place


@dataclass(frozen=True, eq=False)
class PairErrors:
    """error (n, 3): measured less predicted.

    S (n, 3, 3) its covariance; J (n, 3, 6) with respect to the motion's error; depth (n,) predicted, m.
    """

    error: FloatArray
    S: FloatArray
    J: FloatArray
    depth: FloatArray

    @staticmethod
    def room(n: int) -> PairErrors:
        """Room for n pairs."""
        return PairErrors(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 6)), np.empty(n))


@njit(cache=True, nogil=True)
def pair_errors(points, covariances, z, variance, T, centre, lens, error, S, J, depth):  # type: ignore[no-untyped-def]
    """Fill the arrays of :class:`PairErrors` for points (n, 3) of covariance (n, 3, 3) measured as z (n, 3).

    T is the pose of the optical frame in that of the points, ``centre`` the place around which the motion's rotation
    error turns, ``lens`` fx, fy, cx, cy.
    """
    projection = np.zeros((3, 3))
    J_point, mixed = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - T[0, 3], points[n, 1] - T[1, 3], points[n, 2] - T[2, 3]
        x = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
        y = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        depth[n] = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        w = 1.0 / max(depth[n], 1e-3)
        error[n, 0] = z[n, 0] - (lens[0] * x * w + lens[2])
        error[n, 1] = z[n, 1] - (lens[1] * y * w + lens[3])
        error[n, 2] = z[n, 2] - w
        projection[0, 0], projection[0, 2] = lens[0] * w, -lens[0] * x * w * w
        projection[1, 1], projection[1, 2] = lens[1] * w, -lens[1] * y * w * w
        projection[2, 2] = -w * w
        for i in range(3):
            for j in range(3):
                J_point[i, j] = projection[i, 0] * T[j, 0] + projection[i, 1] * T[j, 1] + projection[i, 2] * T[j, 2]
        ax, ay, az = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        for i in range(3):
            a, b, c = J_point[i, 0], J_point[i, 1], J_point[i, 2]
            J[n, i, 0], J[n, i, 1], J[n, i, 2] = -a, -b, -c
            # Row times the cross product matrix of the arm.
            J[n, i, 3], J[n, i, 4], J[n, i, 5] = b * az - c * ay, c * ax - a * az, a * ay - b * ax
            for j in range(3):
                C = covariances[n]
                mixed[i, j] = a * C[0, j] + b * C[1, j] + c * C[2, j]
        for i in range(3):
            for j in range(3):
                S[n, i, j] = mixed[i, 0] * J_point[j, 0] + mixed[i, 1] * J_point[j, 1] + mixed[i, 2] * J_point[j, 2]
            S[n, i, i] += variance[n, i]


@in_place()
def _factor(S, scale, L):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor of S scaled by rows and columns."""
    L[0, 0] = np.sqrt(S[0, 0]) * scale[0]
    L[1, 0] = S[1, 0] * scale[1] * scale[0] / L[0, 0]
    L[1, 1] = np.sqrt(max(S[1, 1] * scale[1] ** 2 - L[1, 0] ** 2, 1e-300))
    L[2, 0] = S[2, 0] * scale[2] * scale[0] / L[0, 0]
    L[2, 1] = (S[2, 1] * scale[2] * scale[1] - L[2, 0] * L[1, 0]) / L[1, 1]
    L[2, 2] = np.sqrt(max(S[2, 2] * scale[2] ** 2 - L[2, 0] ** 2 - L[2, 1] ** 2, 1e-300))


@njit(cache=True, nogil=True)
def gated(error, S, depth, scale, gate):  # type: ignore[no-untyped-def]
    """Mask (n,) of the pairs that lie inside the gate and before the camera.

    Standard deviations are multiplied by ``scale`` (3,).
    """
    out = np.zeros(len(error), np.bool_)
    L = np.zeros((3, 3))
    for n in range(len(error)):
        _factor(S[n], scale, L)
        a = error[n, 0] / L[0, 0]
        b = (error[n, 1] - L[1, 0] * a) / L[1, 1]
        c = (error[n, 2] - L[2, 0] * a - L[2, 1] * b) / L[2, 2]
        out[n] = a * a + b * b + c * c < gate and depth[n] > MIN_DEPTH
    return out


@njit(cache=True, nogil=True)
def normal_equations(error, S, J, chosen, scale):  # type: ignore[no-untyped-def]
    """``sum J' S^-1 J`` (6, 6) and ``sum J' S^-1 error`` (6,) of the chosen pairs, S scaled as in :func:`gated`."""
    information, gradient = np.zeros((6, 6)), np.zeros(6)
    L, W = np.zeros((3, 3)), np.empty((3, 7))
    for n in range(len(error)):
        if not chosen[n]:
            continue
        _factor(S[n], scale, L)
        for k in range(7):
            for i in range(3):
                value = error[n, i] if k == 6 else J[n, i, k]
                for j in range(i):
                    value -= L[i, j] * W[j, k]
                W[i, k] = value / L[i, i]
        for p in range(6):
            for q in range(p + 1):
                information[p, q] += W[0, p] * W[0, q] + W[1, p] * W[1, q] + W[2, p] * W[2, q]
            gradient[p] += W[0, p] * W[0, 6] + W[1, p] * W[1, 6] + W[2, p] * W[2, 6]
    for p in range(6):
        for q in range(p):
            information[q, p] = information[p, q]
    return information, gradient


@njit(cache=True, nogil=True)
def readout_equations(error, S, J, slope, scale, x, huber, information, gradient):  # type: ignore[no-untyped-def]
    """Fill ``sum w H' S^-1 H`` (7, 7) and ``sum w H' S^-1 error`` (7,) of all pairs, H = (J, -slope), at x (7,).

    S is scaled as in :func:`gated`; w falls where ``error - H x`` is beyond ``huber`` standard deviations (Huber 1964).
    """
    information[:], gradient[:] = 0.0, 0.0
    L, W = np.zeros((3, 3)), np.empty((3, 8))
    for n in range(len(error)):
        _factor(S[n], scale, L)
        for k in range(8):
            for i in range(3):
                value = error[n, i] if k == 7 else (-slope[n, i] if k == 6 else J[n, i, k])
                for j in range(i):
                    value -= L[i, j] * W[j, k]
                W[i, k] = value / L[i, i]
        distance = 0.0
        for i in range(3):
            left = W[i, 7]
            for k in range(7):
                left -= W[i, k] * x[k]
            distance += left * left
        weight = 1.0 / max(1.0, np.sqrt(distance) / huber)
        for p in range(7):
            for q in range(p + 1):
                information[p, q] += weight * (W[0, p] * W[0, q] + W[1, p] * W[1, q] + W[2, p] * W[2, q])
            gradient[p] += weight * (W[0, p] * W[0, 7] + W[1, p] * W[1, 7] + W[2, p] * W[2, 7])
    for p in range(7):
        for q in range(p):
            information[q, p] = information[p, q]


@njit(cache=True, nogil=True)
def first_of_both(rows, columns, row_count, column_count):  # type: ignore[no-untyped-def]
    """Mask (n,) of the pairs whose row and column no pair before them has taken."""
    row_taken, column_taken = np.zeros(row_count, np.bool_), np.zeros(column_count, np.bool_)
    out = np.zeros(len(rows), np.bool_)
    for k in range(len(rows)):
        out[k] = not row_taken[rows[k]] and not column_taken[columns[k]]
        if out[k]:
            row_taken[rows[k]] = column_taken[columns[k]] = True
    return out
