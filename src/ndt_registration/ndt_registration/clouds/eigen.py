# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra for the compiled kernels.

Symmetric 3x3 eigenvalues and 6x6 Cholesky, without LAPACK's overhead.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

LANES = 32
"""Matrices whose eigenvalues are computed at once."""
_NEARLY_EQUAL = 1e-6
"""One less the cosine that shows two equal eigenvalues, below which the closed form loses digits."""
_LEAST_RADIUS = 1e-90
"""Spread of the eigenvalues whose cube is still a number."""


@in_place()
def symmetric_eigen3(m, a, vectors, values):  # type: ignore[no-untyped-def]
    """Eigenvalues (ascending) and eigenvectors of ``LANES`` symmetric matrices, 3 x 3, at once.

    In closed form, but where two eigenvalues are nearly equal by Jacobi's rotations. ``m``, flat (19 LANES,): rows xx
    xy xz yy yz zz are read, then three rows of eigenvalues, three each of the vectors of the least, the middle and the
    largest, and one of flags are written. ``a``, ``vectors`` (3, 3) and ``values`` (3,) are room.
    """
    _closed_form(m)
    for j in range(LANES):
        if m[18 * LANES + j] == 0.0:
            _read_matrix(m, j, a)
            _jacobi_eigen3(a, vectors, values)
            for k in range(3):
                m[(6 + k) * LANES + j] = values[k]
                for i in range(3):
                    m[(9 + 3 * k + i) * LANES + j] = vectors[i, k]


@in_place()
def _read_matrix(m, j, a):  # type: ignore[no-untyped-def]
    row = 0
    for r in range(3):
        for c in range(r, 3):
            a[r, c] = a[c, r] = m[row * LANES + j]
            row += 1


# No branch in the loop: so the compiler takes eight matrices at once.
@in_place(error_model="numpy")
def _closed_form(m):  # type: ignore[no-untyped-def]
    """The eigenvalue that stands apart is twice the radius times ``x``, ``4 x^3 - 3 x = cosine`` (Smith 1961)."""
    for j in range(LANES):
        xx, p, q, yy, r, zz = _row(m, 0, j), _row(m, 1, j), _row(m, 2, j), _row(m, 3, j), _row(m, 4, j), _row(m, 5, j)
        mean = (xx + yy + zz) / 3.0
        x, y, z = xx - mean, yy - mean, zz - mean
        radius = np.sqrt((x * x + y * y + z * z + 2.0 * (p * p + q * q + r * r)) / 6.0)
        divisor = radius if radius > _LEAST_RADIUS else 1.0
        cosine = 0.5 * (x * (y * z - r * r) - p * (p * z - q * r) + q * (p * r - q * y)) / (divisor * divisor * divisor)
        closed = (radius > _LEAST_RADIUS) & (abs(cosine) < 1.0 - _NEARLY_EQUAL)
        apart = _largest_root(min(abs(cosine), 1.0))
        half = np.sqrt(0.75 * max(1.0 - apart * apart, 0.0))
        apart = apart if cosine >= 0.0 else -apart
        least, largest = (
            (-0.5 * apart - half if cosine >= 0.0 else apart),
            (apart if cosine >= 0.0 else half - 0.5 * apart),
        )
        least, largest = 2.0 * radius * least, 2.0 * radius * largest
        ax, ay, az = _null_vector(x - least, y - least, z - least, p, q, r)
        bx, by, bz = _null_vector(x - largest, y - largest, z - largest, p, q, r)
        along = ax * bx + ay * by + az * bz
        bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
        length = np.sqrt(bx * bx + by * by + bz * bz)
        bx, by, bz = bx / length, by / length, bz / length
        m[6 * LANES + j], m[7 * LANES + j], m[8 * LANES + j] = mean + least, mean - least - largest, mean + largest
        m[9 * LANES + j], m[10 * LANES + j], m[11 * LANES + j] = ax, ay, az
        m[12 * LANES + j], m[13 * LANES + j], m[14 * LANES + j] = (
            by * az - bz * ay,
            bz * ax - bx * az,
            bx * ay - by * ax,
        )
        m[15 * LANES + j], m[16 * LANES + j], m[17 * LANES + j] = bx, by, bz
        m[18 * LANES + j] = 1.0 if closed else 0.0


@njit(cache=True, nogil=True, inline="always")
def _row(m, row, j):  # type: ignore[no-untyped-def]
    return m[row * LANES + j]


@njit(cache=True, nogil=True, inline="always")
def _largest_root(cosine):  # type: ignore[no-untyped-def]
    """``cos(arccos(cosine) / 3)`` of a cosine from 0 to 1: three of Newton's steps from a parabola near by."""
    x = 0.8660254 + cosine * (0.1667 - 0.0327 * cosine)
    x -= (x * (4.0 * x * x - 3.0) - cosine) / (12.0 * x * x - 3.0)
    x -= (x * (4.0 * x * x - 3.0) - cosine) / (12.0 * x * x - 3.0)
    x -= (x * (4.0 * x * x - 3.0) - cosine) / (12.0 * x * x - 3.0)
    return x


@njit(cache=True, nogil=True, inline="always")
def _null_vector(x, y, z, p, q, r):  # type: ignore[no-untyped-def]
    """Unit vector that ``[x p q; p y r; q r z]`` of rank two maps to zero: the longest cross product of its rows."""
    ux, uy, uz = p * r - q * y, q * p - x * r, x * y - p * p
    vx, vy, vz = y * z - r * r, r * q - p * z, p * r - y * q
    wx, wy, wz = r * q - z * p, z * x - q * q, q * p - r * x
    u, v, w = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    ux, uy, uz, u = (vx if v > u else ux), (vy if v > u else uy), (vz if v > u else uz), max(u, v)
    ux, uy, uz, u = (wx if w > u else ux), (wy if w > u else uy), (wz if w > u else uz), max(u, w)
    length = np.sqrt(u)
    return ux / length, uy / length, uz / length


@in_place()
def _jacobi_eigen3(a: FloatArray, vectors: FloatArray, values: FloatArray) -> None:
    """Eigenvalues and eigenvectors by cyclic Jacobi rotations."""
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
