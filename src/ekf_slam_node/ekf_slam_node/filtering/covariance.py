# SPDX-License-Identifier: Apache-2.0
"""The covariance of a state that grows and shrinks: one class owns the matrix and every operation on it.

Only the lower triangle is kept true, which halves the cost of the update (BLAS dsyrk, Eq. 6.20). The buffer is larger
than the state, so that landmarks come and go without a copy; a removed landmark's place is taken by the last one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.linear_algebra import blas, blas_kernels
from slam_core.runtime.in_place import in_place

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


@in_place()
def _gather_blocks(P, first, out):  # type: ignore[no-untyped-def]
    """Fill out (k, w, w) with the diagonal blocks of the symmetric P that start at rows ``first`` (k,)."""
    for k in range(len(first)):
        for i in range(out.shape[1]):
            for j in range(i + 1):
                out[k, i, j] = out[k, j, i] = P[first[k] + i, first[k] + j]


@in_place()
def _gather_all(P, kept, out):  # type: ignore[no-untyped-def]
    """``out[i, j] = P[kept[i], kept[j]]`` for rising rows ``kept`` (k,) of the symmetric P."""
    for j in range(len(kept)):
        for i in range(j, len(kept)):
            out[i, j] = out[j, i] = P[kept[i], kept[j]]


@in_place()
def _append_points(P, size, head, arms, covariances):  # type: ignore[no-untyped-def]
    """Add the rows of points at ``arms`` (k, 3) from the pose, whose errors are its own, turn times arm, and their own.

    ``head`` (size, 6): covariance of everything with the pose; ``covariances`` (k, 3, 3): of the own errors.
    """
    for column in range(size + 3 * len(arms)):
        h = head[column] if column < size else P[column, :6]
        for k in range(max(column - size, 0) // 3, len(arms)):
            row, x, y, z = size + 3 * k, arms[k, 0], arms[k, 1], arms[k, 2]
            P[row, column] = h[0] - y * h[5] + z * h[4]
            P[row + 1, column] = h[1] - z * h[3] + x * h[5]
            P[row + 2, column] = h[2] - x * h[4] + y * h[3]
    for k in range(len(arms)):
        for i in range(3):
            for j in range(3):
                P[size + 3 * k + i, size + 3 * k + j] += covariances[k, i, j]


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
    def buffer(self) -> FloatArray:
        """The matrix for compiled kernels: its first ``size`` rows and columns count, of these the lower triangle."""
        return self._P

    @property
    def _state(self) -> FloatArray:
        """The part of the buffer that is in use."""
        return self._P[: self.size, : self.size]

    def dense(self, kept: IndexArray | None = None) -> FloatArray:
        """A full symmetric copy (n, n); only rows and columns ``kept`` (k,), in rising order, where these are given."""
        rows = np.arange(self.size) if kept is None else kept
        out = np.empty((len(rows), len(rows)))
        _gather_all(self._P, rows, out)
        return out

    def columns(self, index: IndexArray) -> FloatArray:
        """Columns ``index`` (k,) as an array (n, k)."""
        out = np.empty((self.size, len(index)), order="F")
        _gather_columns(self._P, np.asarray(index, dtype=np.int64), self.size, out)
        return out

    def head(self, rows: int) -> FloatArray:
        """The first ``rows`` columns (n, rows): covariance of everything with the head of the state."""
        out = np.empty((self.size, rows))
        _gather_columns(self._P, np.arange(rows), self.size, out)
        return out

    def blocks(self, first: IndexArray, width: int = 3) -> FloatArray:
        """Diagonal blocks (k, width, width) that start at rows ``first`` (k,)."""
        out = np.empty((len(first), width, width))
        _gather_blocks(self._P, np.asarray(first), out)
        return out

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

    def append_points(self, arms: FloatArray, covariances: FloatArray) -> None:
        """Add points at ``arms`` (k, 3) from the pose with errors of their own (k, 3, 3) (Eq. 6.23)."""
        self._reserve(self.size + 3 * len(arms))
        _append_points(self._P, self.size, self.head(6), arms, covariances)
        self.size += 3 * len(arms)

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
        Innovation covariance (k, k), lower triangle used; in Fortran order it is overwritten.
    cross
        ``P H'`` (n, k) in Fortran order, overwritten.
    innovation
        (k,).

    Returns
    -------
    W = P H' L^-T and y = L^-1 innovation with S = L L'; the gain is applied as ``x += W y``, ``P -= W W'`` and y'y is
    the NIS. None if S is not positive definite.
    """
    if not cross.flags.f_contiguous:
        raise ValueError(f"P H' must be in Fortran order, got strides {cross.strides}")
    y = np.array(innovation, dtype=np.float64)
    return (cross, y) if blas_kernels.whiten(np.asfortranarray(S), cross, y) else None
