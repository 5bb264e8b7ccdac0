# SPDX-License-Identifier: Apache-2.0
"""Kernels for small matrices and poses, for which a call of LAPACK or NumPy costs more than the work."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place


@in_place()
def solved_square(A: FloatArray, x: FloatArray) -> tuple[float, float]:
    """``x^T A^-1 x`` and ``log det A`` of a positive definite matrix (n, n) and a vector (n,).

    In place: the lower triangle of A becomes its Cholesky factor L, and x becomes ``L^-1 x``.
    """
    total = log_det = 0.0
    for i in range(len(x)):
        for j in range(i):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
            A[i, i] -= A[i, j] * A[i, j]
            x[i] -= A[i, j] * x[j]
        log_det += np.log(A[i, i])
        A[i, i] = np.sqrt(A[i, i])
        x[i] /= A[i, i]
        total += x[i] * x[i]
    return total, log_det


@in_place()
def rotate_columns(T: FloatArray, x: float, y: float, z: float, columns: int) -> None:
    """Rotate the first ``columns`` of the upper rows of T (4, 4) by the rotation vector x, y, z (rad; Rodrigues)."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > 1e-4:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    for j in range(columns):
        p, q, r = T[0, j], T[1, j], T[2, j]
        u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
        T[0, j] = p + a * u + b * (y * w - z * v)
        T[1, j] = q + a * v + b * (z * u - x * w)
        T[2, j] = r + a * w + b * (x * v - y * u)
