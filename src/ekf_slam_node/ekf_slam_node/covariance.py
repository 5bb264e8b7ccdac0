# SPDX-License-Identifier: Apache-2.0
"""The covariance of a state that grows and shrinks: one class owns the matrix and every operation on it.

Only the lower triangle is kept true, which halves the cost of the update (BLAS dsyrk, Eq. 6.20). The buffer is larger
than the state, so that landmarks come and go without a copy; a removed landmark's place is taken by the last one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.linalg import lapack

from slam_core.geometry import FloatArray
from slam_core.in_place import in_place
from slam_core.linear_algebra import blas

IndexArray = npt.NDArray[np.int64]
_GROWTH = 1.4
"""Room for so much larger a state is taken when it runs out."""


@in_place()
def _gather_columns(P, index, size, out):  # type: ignore[no-untyped-def]
    """``out[:size, k] = P[:size, index[k]]`` of the symmetric matrix whose lower triangle is P's."""
    for k in range(len(index)):
        j = index[k]
        for i in range(j):
            out[i, k] = P[j, i]
        for i in range(j, size):
            out[i, k] = P[i, j]


@njit(cache=True, nogil=True)
def _cross_covariance(P, size, core, J_pose, J_point, rows, out):  # type: ignore[no-untyped-def]
    """``out = P H'`` for observations that touch the pose (first six) and three entries from rows[k] each."""
    x, y, z = np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(rows)):
        first = rows[k]
        for i in range(first + 3):
            x[i], y[i], z[i] = P[first, i], P[first + 1, i], P[first + 2, i]
        x[first + 1], x[first + 2], y[first + 2] = P[first + 1, first], P[first + 2, first], P[first + 2, first + 1]
        for i in range(first + 3, size):
            x[i], y[i], z[i] = P[i, first], P[i, first + 1], P[i, first + 2]
        for m in range(3):
            _combine(x, y, z, core, J_point[k, m], J_pose[k, m], out[:, 3 * k + m])


@in_place()
def _combine(x, y, z, core, a, b, out):  # type: ignore[no-untyped-def]
    a0, a1, a2, b0, b1, b2, b3, b4, b5 = a[0], a[1], a[2], b[0], b[1], b[2], b[3], b[4], b[5]
    for i in range(len(x)):
        point = a0 * x[i] + a1 * y[i] + a2 * z[i] + b0 * core[i, 0] + b1 * core[i, 1] + b2 * core[i, 2]
        out[i] = point + b3 * core[i, 3] + b4 * core[i, 4] + b5 * core[i, 5]


class Covariance:
    """Symmetric positive definite matrix of a growing state, ``size`` rows.

    Parameters
    ----------
    initial
        Shape (n, n), the covariance to start with.
    """

    def __init__(self, initial: FloatArray) -> None:
        self.size = 0
        self._P = np.zeros((0, 0), order="F")
        self._reserve(len(initial))
        self.size = len(initial)
        self._state[:] = initial

    @property
    def _state(self) -> FloatArray:
        """The part of the buffer that is in use."""
        return self._P[: self.size, : self.size]

    def dense(self) -> FloatArray:
        """A full symmetric copy (n, n)."""
        lower = np.tril(self._state)
        return np.asarray(lower + np.tril(lower, -1).T)

    def columns(self, index: IndexArray) -> FloatArray:
        """Columns ``index`` (k,) as an array (n, k)."""
        out = np.empty((self.size, len(index)), order="F")
        _gather_columns(self._P, np.asarray(index, dtype=np.int64), self.size, out)
        return out

    def head(self, rows: int) -> FloatArray:
        """The first ``rows`` columns (n, rows): covariance of everything with the head of the state."""
        out = self._P[: self.size, :rows].copy()
        for k in range(rows - 1):
            out[k, k + 1 :] = out[k + 1 : rows, k]
        return out

    def blocks(self, first: IndexArray, width: int = 3) -> FloatArray:
        """Diagonal blocks (k, width, width) that start at rows ``first`` (k,)."""
        index = np.asarray(first)[:, None] + np.arange(width)
        out = self._P[index[:, :, None], index[:, None, :]]
        for k in range(width - 1):
            out[:, k, k + 1 :] = out[:, k + 1 :, k]
        return np.asarray(out)

    def set_head(self, columns: FloatArray) -> None:
        """Replace the first columns by (n, rows), as the time update does."""
        self._P[: self.size, : columns.shape[1]] = columns

    def cross_covariance(self, J_pose: FloatArray, J_point: FloatArray, rows: IndexArray) -> FloatArray:
        """``P H'`` (n, 3 m) of m observations of a pose (head of the state) and of the point at ``rows`` (m,) each."""
        out = np.empty((self.size, 3 * len(rows)), order="F")
        core = np.asfortranarray(self.head(6))
        _cross_covariance(self._P, self.size, core, J_pose, J_point, np.asarray(rows, dtype=np.int64), out)
        return out

    def subtract_square(self, W: FloatArray) -> None:
        """``P <- P - W W'`` (Eq. 6.20) for W (n, k)."""
        blas.subtract_square(self._state, W)

    def add_product(self, A: FloatArray, B: FloatArray) -> None:
        """``P <- P + A B' + B A'`` for A, B (n, k)."""
        blas.add_product(self._state, np.asfortranarray(A), np.asfortranarray(B))

    def append(self, cross: FloatArray, block: FloatArray) -> None:
        """Add rows.

        Their covariance with the state, ``cross`` (k, n), and among themselves, ``block`` (k, k) (Eq. 6.23).
        """
        n, k = self.size, len(block)
        self._reserve(n + k)
        self._P[n : n + k, :n] = cross
        self._P[n : n + k, n : n + k] = block
        self.size = n + k

    def remove(self, first: int, width: int) -> None:
        """Drop rows ``first .. first + width`` (marginalise).

        The last ``width`` rows of the state move into their place.
        """
        last = self.size - width
        if first != last:
            moved = self.columns(np.arange(last, self.size))
            own = self.blocks(np.array([last]), width)[0]
            self._P[first : first + width, :first] = moved[:first].T
            self._P[first : first + width, first : first + width] = own
            self._P[first + width : last, first : first + width] = moved[first + width : last]
        self.size = last

    def _reserve(self, rows: int) -> None:
        if rows <= len(self._P):
            return
        grown = np.empty((int(_GROWTH * rows),) * 2, order="F")
        grown[: self.size, : self.size] = self._state
        self._P = grown


def whiten(S: FloatArray, cross: FloatArray, innovation: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Cholesky form of the update (Eqs. 6.17-6.19).

    Parameters
    ----------
    S
        Innovation covariance (k, k), lower triangle used.
    cross
        ``P H'`` (n, k), overwritten.
    innovation
        (k,).

    Returns
    -------
    W = P H' L^-T and y = L^-1 innovation with S = L L'; the gain is applied as ``x += W y``, ``P -= W W'`` and y'y is
    the NIS. None if S is not positive definite.
    """
    L = np.array(S, order="F")
    if not blas.cholesky(L):
        return None
    y, _ = lapack.dtrtrs(L, innovation, lower=1)
    blas.solve_right(L, cross)
    return cross, np.asarray(y).ravel()
