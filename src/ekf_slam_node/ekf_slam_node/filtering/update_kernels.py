# SPDX-License-Identifier: Apache-2.0
"""The measurement update in two compiled calls: what a frame's sightings are worth, and the update by those chosen.

They do what :class:`ekf_slam_node.filtering.ekf.Ekf` and ``models.observe`` do with arrays, in the same order. The
covariance is passed as its buffer: Fortran order, ``size`` rows in use, only the lower triangle true.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ekf_slam_node.filtering.measurement_kernels import (
    add_of_points,
    add_of_pose,
    mixed_terms,
    moved_points,
    observed,
    squared_lengths,
)
from slam_core.linear_algebra.blas_kernels import subtract_square_and_add_product
from slam_core.linear_algebra.small_kernels import rotate_columns
from slam_core.runtime.in_place import in_place

_CORE = 12
"""Error coordinates of the rig, see ``models.CORE_DIM``."""


@njit(cache=True, nogil=True, error_model="numpy")
def sighted(  # type: ignore[no-untyped-def]
    P, offset, T, T_camera, landmarks, slots, z, variance, common, lens, seen_z, depth, J_pose, J_point, innovation,
    nis, information,
):  # fmt: skip
    """Fill for sightings z (k, 3) of variance (k, 3) of landmarks ``slots`` (k,) what they are worth.

    seen_z (k, 3), depth (k,), J_pose (k, 3, 6), J_point (k, 3, 3): as predicted. The others: as in ``ekf.Sighted``.
    ``common`` (6,): variances of an error of the pose that all share.
    """
    k = len(slots)
    points, S, blocks, rows = np.empty((k, 3)), np.zeros((k, 3, 3)), np.empty((k, 3, 3)), np.empty(k, np.int64)
    pose, before = np.empty((6, 6)), np.empty(6)
    for i in range(6):
        before[i] = offset[i]
        for j in range(i + 1):
            pose[i, j] = pose[j, i] = P[i, j]
        pose[i, i] += common[i]
    for n in range(k):
        row = _CORE + 3 * slots[n]
        rows[n] = row
        for i in range(3):
            points[n, i] = landmarks[slots[n], i]
            for j in range(i + 1):
                blocks[n, i, j] = blocks[n, j, i] = P[row + i, row + j]
    observed(points, T_camera, T[:3, 3], lens, seen_z, depth, J_pose, J_point)
    add_of_pose(J_pose, pose, S)
    add_of_points(J_point, blocks, S)
    mixed_terms(J_pose, J_point, P, rows, S)
    for n in range(k):
        for i in range(3):
            S[n, i, i] += variance[n, i]
            value = z[n, i] - seen_z[n, i]
            for j in range(6):
                value -= J_pose[n, i, j] * before[j]
            for j in range(3):
                value -= J_point[n, i, j] * offset[rows[n] + j]
            innovation[n, i] = value
        information[n] = _log_ratio(S[n], variance[n])
    squared_lengths(innovation, S, nis)


@in_place(error_model="numpy")
def _log_ratio(S, variance):  # type: ignore[no-untyped-def]
    a, b, c = (
        S[1, 1] * S[2, 2] - S[2, 1] ** 2,
        S[1, 0] * S[2, 2] - S[2, 1] * S[2, 0],
        S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0],
    )
    determinant = S[0, 0] * a - S[1, 0] * b + S[2, 0] * c
    return np.log(determinant / (variance[0] * variance[1] * variance[2]))


@njit(cache=True, nogil=True, error_model="numpy")
def applied(P, W, y, offset, T, velocity, landmarks, invariant):  # type: ignore[no-untyped-def]
    """Apply a whitened update: ``x += offset + W y``, ``P -= W W'``, and the error's coordinates at the new estimate.

    W (n, k), y (k,). T (4, 4), velocity (6,) and landmarks (m, 3) are moved in place; see ``Ekf._change_coordinates``
    for the last step, which is a product of rank three.
    """
    n, k = W.shape
    delta = offset.copy()
    for column in range(k):
        _add_scaled(delta, W[:, column], y[column])
    moved = _moved(T, velocity, landmarks, delta, invariant)
    A, B = np.zeros((3 if invariant else 0, n)), np.zeros((3 if invariant else 0, n))
    if invariant:
        _turned_coordinates(P, W, moved, A, B)
    subtract_square_and_add_product(W, A, B, P)


@njit(cache=True, nogil=True, error_model="numpy")
def _moved(T, velocity, landmarks, delta, invariant):  # type: ignore[no-untyped-def]
    """Move the estimate by an error (n,); returns by what its places have moved (1 + m, 3), the rig's first."""
    m = len(landmarks)
    old, shift, turn = np.empty((m + 1, 3)), np.empty((m + 1, 3)), delta[3:6].copy()
    for i in range(3):
        old[0, i], shift[0, i] = T[i, 3], delta[i]
    for n in range(m):
        for i in range(3):
            old[n + 1, i], shift[n + 1, i] = landmarks[n, i], delta[_CORE + 3 * n + i]
    moved = shift
    if invariant:
        change, V, moved = np.eye(4), np.empty((3, 3)), np.empty((m + 1, 3))
        rotate_columns(change, turn[0], turn[1], turn[2], 3)
        for i in range(3):
            change[i, i] -= 1.0
        _left_jacobian(turn, V)
        moved_points(old, shift, turn, change, V, moved)
    rotate_columns(T, turn[0], turn[1], turn[2], 3)
    for i in range(3):
        T[i, 3] += moved[0, i]
        velocity[i] += delta[6 + i]
        velocity[3 + i] += delta[9 + i]
        for n in range(m):
            landmarks[n, i] += moved[n + 1, i]
    return moved


@in_place(error_model="numpy")
def _left_jacobian(turn, V):  # type: ignore[no-untyped-def]
    """Fill V (3, 3), see ``slam_core.geometry.so3_left_jacobian``."""
    x, y, z = turn[0], turn[1], turn[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    a, b = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    if not angle < 1e-4:
        a, b = (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (angle * square)
    V[0, 0], V[0, 1], V[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    V[1, 0], V[1, 1], V[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    V[2, 0], V[2, 1], V[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@in_place()
def _turned_coordinates(P, W, moved, A, B):  # type: ignore[no-untyped-def]
    """Fill A and B (3, n) so that the change of coordinates after ``P -= W W'`` is ``P += A' B + B' A``.

    A: ``-[moved]x`` of each place; B: the covariance of all with the rotation, plus half of what A adds to it.
    """
    n, k = W.shape
    for i in range(3):
        for j in range(3 + i):
            B[i, j] = P[3 + i, j]
        for j in range(3 + i, n):
            B[i, j] = P[j, 3 + i]
        for column in range(k):
            _add_scaled(B[i], W[:, column], -W[3 + i, column])
    for place in range(len(moved)):
        row = 0 if place == 0 else _CORE + 3 * (place - 1)
        x, y, z = moved[place, 0], moved[place, 1], moved[place, 2]
        A[1, row], A[2, row] = z, -y
        A[0, row + 1], A[2, row + 1] = -z, x
        A[0, row + 2], A[1, row + 2] = y, -x
    for i in range(3):
        # A is zero in the rows of the rotation, so that its own block of B stays as it is.
        a, b, c = 0.5 * B[i, 3], 0.5 * B[i, 4], 0.5 * B[i, 5]
        for j in range(n):
            B[i, j] += A[0, j] * a + A[1, j] * b + A[2, j] * c


@in_place(fastmath={"contract"})
def _add_scaled(out, values, factor):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        out[i] += factor * values[i]
