# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra for the compiled kernels.

Symmetric 3x3 eigenvalues and 6x6 Cholesky, without LAPACK's overhead.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.in_place import in_place

_NEARLY_EQUAL = 1e-6
"""One less the cosine that shows two equal eigenvalues, below which the closed form loses digits."""
_LEAST_RADIUS = 1e-90
"""Spread of the eigenvalues whose cube is still a number."""


@in_place()
def symmetric_eigen3(a: FloatArray, vectors: FloatArray, values: FloatArray) -> None:
    """Eigenvalues (ascending) and eigenvectors (columns) of a symmetric matrix, shape (3, 3).

    In closed form (Smith 1961), a fifth of the time of Jacobi's rotations, which take over where two eigenvalues are
    nearly equal. ``a`` is destroyed, ``vectors`` (3, 3) and ``values`` (3,) are written.
    """
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    x, y, z = a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean
    p, q, r = a[0, 1], a[0, 2], a[1, 2]
    radius = np.sqrt((x * x + y * y + z * z + 2.0 * (p * p + q * q + r * r)) / 6.0)
    determinant = x * (y * z - r * r) - p * (p * z - q * r) + q * (p * r - q * y)
    cosine = 0.5 * determinant / radius**3 if radius > _LEAST_RADIUS else 1.0
    if not abs(cosine) < 1.0 - _NEARLY_EQUAL:
        _jacobi_eigen3(a, vectors, values)
        return
    angle = np.arccos(cosine) / 3.0
    values[2] = mean + 2.0 * radius * np.cos(angle)
    values[0] = mean + 2.0 * radius * np.cos(angle + 2.0 * np.pi / 3.0)
    values[1] = 3.0 * mean - values[0] - values[2]
    _null_vector(a, values[0], vectors[:, 0])
    _null_vector(a, values[2], vectors[:, 2])
    along = vectors[0, 0] * vectors[0, 2] + vectors[1, 0] * vectors[1, 2] + vectors[2, 0] * vectors[2, 2]
    for i in range(3):
        vectors[i, 2] -= along * vectors[i, 0]
    _normalise(vectors[:, 2])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        vectors[i, 1] = vectors[j, 2] * vectors[k, 0] - vectors[k, 2] * vectors[j, 0]


@in_place()
def _null_vector(a: FloatArray, value: float, out: FloatArray) -> None:
    """Unit vector that ``a - value I`` (3, 3) of rank two maps to zero: the longest cross product of its rows."""
    longest = -1.0
    for i in range(3):
        j = (i + 1) % 3
        ux, uy, uz, vx, vy, vz = a[i, 0], a[i, 1], a[i, 2], a[j, 0], a[j, 1], a[j, 2]
        if i == 0:
            ux, vy = ux - value, vy - value
        elif i == 1:
            uy, vz = uy - value, vz - value
        else:
            uz, vx = uz - value, vx - value
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = x * x + y * y + z * z
        if length > longest:
            longest = length
            out[0], out[1], out[2] = x, y, z
    _normalise(out)


@in_place()
def _normalise(v: FloatArray) -> None:
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    for i in range(3):
        v[i] /= length


@in_place()
def _jacobi_eigen3(a: FloatArray, vectors: FloatArray, values: FloatArray) -> None:
    """The same by cyclic Jacobi rotations."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    scale = abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])
    for _ in range(12):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-15 * scale:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                _rotate3(a, vectors, p, q)
    for i in range(3):
        values[i] = a[i, i]
    _sort3(vectors, values)


@in_place()
def _rotate3(a: FloatArray, vectors: FloatArray, p: int, q: int) -> None:
    if a[p, q] == 0.0:
        return
    theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
    t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
    if theta < 0.0:
        t = -t
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    for k in range(3):
        kp, kq = a[k, p], a[k, q]
        a[k, p], a[k, q] = c * kp - s * kq, s * kp + c * kq
    for k in range(3):
        pk, qk = a[p, k], a[q, k]
        a[p, k], a[q, k] = c * pk - s * qk, s * pk + c * qk
    for k in range(3):
        kp, kq = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * kp - s * kq, s * kp + c * kq


@in_place()
def _sort3(vectors: FloatArray, values: FloatArray) -> None:
    for i in range(2):
        low = i
        for j in range(i + 1, 3):
            if values[j] < values[low]:
                low = j
        if low != i:
            values[i], values[low] = values[low], values[i]
            for k in range(3):
                vectors[k, i], vectors[k, low] = vectors[k, low], vectors[k, i]


@njit(cache=True, nogil=True)
def cholesky_solve6(H: FloatArray, damping: FloatArray, g: FloatArray, x: FloatArray) -> bool:
    """Write the solution of ``(H + diag(damping)) x = -g`` (6 unknowns).

    False where that matrix is not positive definite.
    """
    L = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):
            s = H[i, j]
            if i == j:
                s += damping[i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 1e-12 * (abs(H[i, i]) + damping[i]) or s <= 0.0:
                    return False
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(6):
        s = -g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True
