# SPDX-License-Identifier: Apache-2.0
"""Compiled inner loops of the landmark Schur complement: landmarks that are seen one by one from poses.

With the residual turned to map axes, ``e = v - R z`` where ``v = l - t``, its information is ``M = R Omega R^T`` and
its Jacobian ``J = [-I, [v]x]`` for the pose and I for the landmark. A landmark's block ``V = sum M`` has the factor
``V^-1 = K K^T``, and with ``F = M K`` for every sighting the landmark takes ``J_j^T (F_j F_i^T) J_i`` from the block of
every two poses that see it.

The kernels are made for 2 and for 3 dimensions from the same code, so that the compiler sees constant loop bounds.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit


class SightingKernels(NamedTuple):
    """The loops for one dimension; ``sightings`` is :class:`~slam_experiments.linear_slam.block_problem.Sightings`."""

    cost: Callable[..., Any]
    linearize: Callable[..., Any]
    gradient: Callable[..., Any]
    factor_landmarks: Callable[..., Any]
    reduce: Callable[..., Any]
    reduce_gradient: Callable[..., Any]
    recover: Callable[..., Any]


def make_kernels(d: int) -> SightingKernels:
    """Kernels for ``d`` = 2 or 3 dimensions."""
    dp = 3 if d == 2 else 6

    @njit(cache=True, nogil=True)
    def cost(sightings, R, t, points):
        landmark_ptr, pose, mean, information = sightings[:4]
        e = np.empty(d)
        total = 0.0
        for landmark in range(len(landmark_ptr) - 1):
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                i = pose[o]
                for p in range(d):
                    e[p] = -mean[o, p]
                    for q in range(d):
                        e[p] += R[i, q, p] * (points[landmark, q] - t[i, q])
                for p in range(d):
                    for q in range(d):
                        total += e[p] * information[o, p, q] * e[q]
        return total

    @njit(cache=True, nogil=True)
    def linearize(sightings, R, t, points, offset, n, position, stride, values, gradient, M, v, V):
        """Pose blocks into the sparse values, landmark blocks ``V``, ``M`` and ``v`` of every sighting, gradient."""
        landmark_ptr, pose, mean, information = sightings[:4]
        half, weighted, Mv = np.empty((d, d)), np.empty(d), np.empty((d, dp - d))
        for landmark in range(len(landmark_ptr) - 1):
            V[landmark] = 0.0
            if landmark_ptr[landmark] == landmark_ptr[landmark + 1]:  # seen by none: stays there
                for p in range(d):
                    V[landmark, p, p] = 1.0
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                i = pose[o]
                for p in range(d):
                    v[o, p] = points[landmark, p] - t[i, p]
                    for q in range(d):
                        value = 0.0
                        for s in range(d):
                            value += R[i, p, s] * information[o, s, q]
                        half[p, q] = value
                for p in range(d):
                    for q in range(p + 1):
                        value = 0.0
                        for s in range(d):
                            value += half[p, s] * R[i, q, s]
                        M[o, p, q] = value
                        M[o, q, p] = value
                _weigh(half, v[o], M[o], R[i], mean[o], weighted)
                for p in range(d):
                    gradient[n + d * landmark + p] += weighted[p]
                    for q in range(d):
                        V[landmark, p, q] += M[o, p, q]
                at = offset[i]
                if at < 0:
                    continue
                _pull(v[o], weighted, gradient, at)
                # J^T M J with J = [-I, [v]x], lower triangle.
                _turn_rows(M[o], v[o], Mv)
                base, step = position[i], stride[i]
                for q in range(d):
                    for p in range(q, d):
                        values[base + q * step + p] += M[o, p, q]
                    for a in range(dp - d):
                        values[base + q * step + d + a] -= Mv[q, a]
                _turn_block(Mv, v[o], values, base + d * step + d, step)

    @njit(cache=True, nogil=True, inline="always")
    def _weigh(half, v, M, R, mean, out):
        """``M (v - R z)``; ``half`` is not needed any more."""
        for p in range(d):
            half[0, p] = v[p]
            for s in range(d):
                half[0, p] -= R[p, s] * mean[s]
        for p in range(d):
            value = 0.0
            for q in range(d):
                value += M[p, q] * half[0, q]
            out[p] = value

    @njit(cache=True, nogil=True, inline="always")
    def _pull(v, weighted, gradient, at):
        """Add ``J^T weighted``."""
        for p in range(d):
            gradient[at + p] -= weighted[p]
        if d == 2:
            gradient[at + 2] += v[1] * weighted[0] - v[0] * weighted[1]
        else:
            gradient[at + 3] -= v[1] * weighted[2] - v[2] * weighted[1]
            gradient[at + 4] -= v[2] * weighted[0] - v[0] * weighted[2]
            gradient[at + 5] -= v[0] * weighted[1] - v[1] * weighted[0]

    @njit(cache=True, nogil=True, inline="always")
    def _turn_rows(M, v, out):
        """``M [v]x``; in the plane M times the column (v1, -v0)."""
        for p in range(d):
            if d == 2:
                out[p, 0] = M[p, 0] * v[1] - M[p, 1] * v[0]
            else:
                out[p, 0] = M[p, 1] * v[2] - M[p, 2] * v[1]
                out[p, 1] = M[p, 2] * v[0] - M[p, 0] * v[2]
                out[p, 2] = M[p, 0] * v[1] - M[p, 1] * v[0]

    @njit(cache=True, nogil=True, inline="always")
    def _turn_block(Mv, v, values, base, step):
        """Add the lower triangle of ``[v]x^T M [v]x``."""
        if d == 2:
            values[base] += v[1] * Mv[0, 0] - v[0] * Mv[1, 0]
        else:
            for q in range(3):
                if q < 1:
                    values[base + q * step] += v[2] * Mv[1, q] - v[1] * Mv[2, q]
                if q < 2:
                    values[base + q * step + 1] += v[0] * Mv[2, q] - v[2] * Mv[0, q]
                values[base + q * step + 2] += v[1] * Mv[0, q] - v[0] * Mv[1, q]

    @njit(cache=True, nogil=True)
    def gradient(sightings, R, t, points, offset, n, out):
        """Add the gradient alone."""
        landmark_ptr, pose, mean, information = sightings[:4]
        v, e, local, weighted = np.empty(d), np.empty(d), np.empty(d), np.empty(d)
        for landmark in range(len(landmark_ptr) - 1):
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                i = pose[o]
                for p in range(d):
                    v[p] = points[landmark, p] - t[i, p]
                for p in range(d):
                    e[p] = -mean[o, p]
                    for q in range(d):
                        e[p] += R[i, q, p] * v[q]
                for p in range(d):
                    local[p] = 0.0
                    for q in range(d):
                        local[p] += information[o, p, q] * e[q]
                for p in range(d):
                    weighted[p] = 0.0
                    for q in range(d):
                        weighted[p] += R[i, p, q] * local[q]
                    out[n + d * landmark + p] += weighted[p]
                if offset[i] >= 0:
                    _pull(v, weighted, out, offset[i])

    @njit(cache=True, nogil=True)
    def factor_landmarks(sightings, damping, M, V, K, F):
        """``K`` of every landmark from its damped block, and ``F`` of every sighting."""
        landmark_ptr = sightings[0]
        L = np.zeros((d, d))
        for landmark in range(len(landmark_ptr) - 1):
            for j in range(d):
                pivot = V[landmark, j, j] * (1.0 + damping)
                for s in range(j):
                    pivot -= L[j, s] * L[j, s]
                if not pivot > 0.0:
                    return False
                L[j, j] = math.sqrt(pivot)
                for i in range(j + 1, d):
                    value = V[landmark, i, j]
                    for s in range(j):
                        value -= L[i, s] * L[j, s]
                    L[i, j] = value / L[j, j]
            # K = L^-T, upper triangular.
            for j in range(d):
                for i in range(d):
                    K[landmark, j, i] = 0.0
            for j in range(d):
                K[landmark, j, j] = 1.0 / L[j, j]
                for i in range(j + 1, d):
                    value = 0.0
                    for s in range(j, i):
                        value -= L[i, s] * K[landmark, j, s]
                    K[landmark, j, i] = value / L[i, i]
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                for p in range(d):
                    for q in range(d):
                        value = 0.0
                        for s in range(q + 1):
                            value += M[o, p, s] * K[landmark, s, q]
                        F[o, p, q] = value
        return True

    @njit(cache=True, nogil=True, fastmath={"contract"})
    def reduce(sightings, pair_ptr, pair, stride, v, F, values):
        """Take ``J_j^T (F_j F_i^T) J_i`` from the block of every two poses that see a landmark.

        ``pair`` says where it is. Columns belong to the pose that is eliminated first.
        """
        landmark_ptr, pose = sightings[0], sightings[1]
        for landmark in range(len(landmark_ptr) - 1):
            last = landmark_ptr[landmark + 1]
            for o in range(landmark_ptr[landmark], last):
                step, own = stride[pose[o]], v[o]
                for other in range(o, last):
                    base = pair[pair_ptr[o] + other - o]
                    if base >= 0:
                        _take_block(F[other], F[o], v[other], own, values, base, step)

    @njit(cache=True, nogil=True, fastmath={"contract"}, inline="always")
    def _take_block(A, B, v, w, values, base, step):
        """Subtract ``J(v)^T (A B^T) J(w)``, column by column."""
        if d == 2:
            x0, y0, x1, y1 = _dot(A, B, 0, 0), _dot(A, B, 1, 0), _dot(A, B, 0, 1), _dot(A, B, 1, 1)
            _take_column(x0, y0, 0.0, v, values, base)
            _take_column(x1, y1, 0.0, v, values, base + step)
            _take_column(w[0] * x1 - w[1] * x0, w[0] * y1 - w[1] * y0, 0.0, v, values, base + 2 * step)
        else:
            x0, y0, z0 = _dot(A, B, 0, 0), _dot(A, B, 1, 0), _dot(A, B, 2, 0)
            x1, y1, z1 = _dot(A, B, 0, 1), _dot(A, B, 1, 1), _dot(A, B, 2, 1)
            x2, y2, z2 = _dot(A, B, 0, 2), _dot(A, B, 1, 2), _dot(A, B, 2, 2)
            a, b, c = w[0], w[1], w[2]
            _take_column(x0, y0, z0, v, values, base)
            _take_column(x1, y1, z1, v, values, base + step)
            _take_column(x2, y2, z2, v, values, base + 2 * step)
            _take_column(b * x2 - c * x1, b * y2 - c * y1, b * z2 - c * z1, v, values, base + 3 * step)
            _take_column(c * x0 - a * x2, c * y0 - a * y2, c * z0 - a * z2, v, values, base + 4 * step)
            _take_column(a * x1 - b * x0, a * y1 - b * y0, a * z1 - b * z0, v, values, base + 5 * step)

    @njit(cache=True, nogil=True, fastmath={"contract"}, inline="always")
    def _dot(A, B, p, q):
        value = A[p, 0] * B[q, 0] + A[p, 1] * B[q, 1]
        return value if d == 2 else value + A[p, 2] * B[q, 2]

    @njit(cache=True, nogil=True, fastmath={"contract"}, inline="always")
    def _take_column(x, y, z, v, values, at):
        """Subtract ``-J(v)^T (x, y, z)``: itself and ``v x (x, y, z)``."""
        values[at] -= x
        values[at + 1] -= y
        if d == 2:
            values[at + 2] -= v[0] * y - v[1] * x
        else:
            values[at + 2] -= z
            values[at + 3] -= v[1] * z - v[2] * y
            values[at + 4] -= v[2] * x - v[0] * z
            values[at + 5] -= v[0] * y - v[1] * x

    @njit(cache=True, nogil=True)
    def reduce_gradient(sightings, offset, n, v, K, F, gradient):
        """Take what the landmarks explain from the poses' gradient; theirs becomes ``K^T g``."""
        landmark_ptr, pose = sightings[0], sightings[1]
        own, pulled = np.empty(d), np.empty(d)
        for landmark in range(len(landmark_ptr) - 1):
            at = n + d * landmark
            for q in range(d):
                own[q] = 0.0
                for p in range(q + 1):
                    own[q] += K[landmark, p, q] * gradient[at + p]
            for q in range(d):
                gradient[at + q] = own[q]
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                if offset[pose[o]] >= 0:
                    for p in range(d):
                        pulled[p] = 0.0
                        for q in range(d):
                            pulled[p] -= F[o, p, q] * own[q]
                    _pull(v[o], pulled, gradient, offset[pose[o]])

    @njit(cache=True, nogil=True)
    def recover(sightings, offset, n, v, K, F, gradient, step):
        """Steps of the landmarks, ``-K (K^T g + sum F^T J step)``, behind those of the poses."""
        landmark_ptr, pose = sightings[0], sightings[1]
        own, moved = np.empty(d), np.empty(d)
        for landmark in range(len(landmark_ptr) - 1):
            at = n + d * landmark
            for q in range(d):
                own[q] = gradient[at + q]
            for o in range(landmark_ptr[landmark], landmark_ptr[landmark + 1]):
                source = offset[pose[o]]
                if source >= 0:
                    _move(v[o], step, source, moved)
                    for q in range(d):
                        for p in range(d):
                            own[q] += F[o, p, q] * moved[p]
            for p in range(d):
                value = 0.0
                for q in range(p, d):
                    value -= K[landmark, p, q] * own[q]
                step[at + p] = value

    @njit(cache=True, nogil=True, inline="always")
    def _move(v, step, at, out):
        """``J step``."""
        for p in range(d):
            out[p] = -step[at + p]
        if d == 2:
            out[0] += v[1] * step[at + 2]
            out[1] -= v[0] * step[at + 2]
        else:
            out[0] += v[1] * step[at + 5] - v[2] * step[at + 4]
            out[1] += v[2] * step[at + 3] - v[0] * step[at + 5]
            out[2] += v[0] * step[at + 4] - v[1] * step[at + 3]

    return SightingKernels(cost, linearize, gradient, factor_landmarks, reduce, reduce_gradient, recover)


KERNELS = {2: make_kernels(2), 3: make_kernels(3)}


@njit(cache=True, nogil=True)
def counting_order(keys, count):
    """Start of each of the keys 0 ... count - 1 in the stable order that sorts ``keys``, and that order."""
    ptr = np.zeros(count + 1, np.int64)
    for key in keys:
        ptr[key + 1] += 1
    ptr = np.cumsum(ptr)
    following, order = ptr[:-1].copy(), np.empty(len(keys), np.int64)
    for i in range(len(keys)):
        order[following[keys[i]]] = i
        following[keys[i]] += 1
    return ptr, order


@njit(cache=True, nogil=True)
def pose_pairs(landmark_ptr, by_landmark, pose_ptr, by_pose, pose, landmark):
    """Every two poses (first < second) that see the same landmark, once."""
    count = len(pose_ptr) - 1
    mark = np.full(count, -1, np.int64)
    first, second = np.empty(16 * count + 16, np.int64), np.empty(16 * count + 16, np.int64)
    found = 0
    for i in range(count):
        if found + count > len(first):
            first = np.concatenate((first, np.empty(len(first) + count, np.int64)))
            second = np.concatenate((second, np.empty(len(second) + count, np.int64)))
        for k in range(pose_ptr[i], pose_ptr[i + 1]):
            seen = landmark[by_pose[k]]
            for o in range(landmark_ptr[seen], landmark_ptr[seen + 1]):
                j = pose[by_landmark[o]]
                if j > i and mark[j] != i:
                    mark[j] = i
                    first[found], second[found] = i, j
                    found += 1
    return first[:found], second[:found]


@njit(cache=True, nogil=True)
def pair_positions(landmark_ptr, landmark, pose, pose_ptr, by_pose, block, column_ptr, rows, base):
    """Start of the block of each pair of sightings among the sparse values.

    Of every sighting and those behind it of the same landmark (sorted by elimination); -1 for fixed poses. ``block``
    (P,) is a pose's block, -1 for a fixed one.
    """
    pair_ptr = np.zeros(len(pose) + 1, np.int64)
    for o in range(len(pose)):
        pair_ptr[o + 1] = pair_ptr[o] + landmark_ptr[landmark[o] + 1] - o
    pair = np.full(pair_ptr[len(pose)], -1, np.int64)
    slot = np.full(len(column_ptr), -1, np.int64)
    for i in range(len(pose_ptr) - 1):
        if block[i] < 0:
            continue
        for k in range(column_ptr[block[i]], column_ptr[block[i] + 1]):
            slot[rows[k]] = base[k]
        for k in range(pose_ptr[i], pose_ptr[i + 1]):
            o = by_pose[k]
            for other in range(o, landmark_ptr[landmark[o] + 1]):
                if block[pose[other]] >= 0:
                    pair[pair_ptr[o] + other - o] = slot[block[pose[other]]]
    return pair_ptr, pair
