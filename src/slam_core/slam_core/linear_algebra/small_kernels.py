# SPDX-License-Identifier: Apache-2.0
"""Kernel for matrices with a few rows, for which a call of LAPACK costs more than the work."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.in_place import in_place


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
