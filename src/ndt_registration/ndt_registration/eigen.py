"""Small dense linear algebra for the compiled kernels: symmetric 3x3 eigenvalues and 6x6 Cholesky, without LAPACK's
overhead.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray


@njit(cache=True, nogil=True)
def symmetric_eigen3(a: FloatArray, vectors: FloatArray, values: FloatArray) -> None:
    """Eigenvalues (ascending) and eigenvectors (columns) of a symmetric matrix, shape (3, 3), by cyclic Jacobi
    rotations.

    ``a`` is destroyed, ``vectors`` (3, 3) and ``values`` (3,) are written.
    """
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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
    """Write the solution of ``(H + diag(damping)) x = -g`` (6 unknowns); False where that matrix is not positive
    definite.
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
