"""The covariance of a state that grows and shrinks: one class owns the matrix and every operation on it.

Only the lower triangle is kept true, which halves the cost of the update (BLAS dsyrk, Eq. 6.20). The buffer is padded
with zeros beyond the state, so that BLAS works on one contiguous matrix while landmarks come and go; a removed
landmark's place is taken by the last one.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.linalg import lapack

from slam_core import blas
from slam_core.geometry import FloatArray

IndexArray = npt.NDArray[np.int64]
_GROWTH = 96


@njit(cache=True, nogil=True)
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
    column = np.empty((3, size))
    for k in range(len(rows)):
        first = rows[k]
        for c in range(3):
            j = first + c
            for i in range(j):
                column[c, i] = P[j, i]
            for i in range(j, size):
                column[c, i] = P[i, j]
        for m in range(3):
            target = 3 * k + m
            a0, a1, a2 = J_point[k, m, 0], J_point[k, m, 1], J_point[k, m, 2]
            for i in range(size):
                out[i, target] = a0 * column[0, i] + a1 * column[1, i] + a2 * column[2, i]
            for p in range(6):
                b = J_pose[k, m, p]
                for i in range(size):
                    out[i, target] += b * core[i, p]


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
        self._P[: self.size, : self.size] = initial

    @property
    def capacity(self) -> int:
        """Rows of the buffer; matrices handed to :meth:`subtract_square` have as many."""
        return len(self._P)

    def dense(self) -> FloatArray:
        """A full symmetric copy (n, n)."""
        lower = np.tril(self._P[: self.size, : self.size])
        return np.asarray(lower + np.tril(lower, -1).T)

    def columns(self, index: IndexArray) -> FloatArray:
        """Columns ``index`` (k,) as an array (capacity, k), rows beyond the state zero."""
        out = np.zeros((self.capacity, len(index)), order="F")
        _gather_columns(self._P, np.asarray(index, dtype=np.int64), self.size, out)
        return out

    def head(self, rows: int) -> FloatArray:
        """The first ``rows`` columns (n, rows): covariance of everything with the head of the state."""
        out = self._P[: self.size, :rows].copy()
        square = out[:rows]
        out[:rows] = np.tril(square) + np.tril(square, -1).T
        return out

    def blocks(self, first: IndexArray, width: int = 3) -> FloatArray:
        """Diagonal blocks (k, width, width) that start at rows ``first`` (k,)."""
        index = np.asarray(first)[:, None] + np.arange(width)
        lower = np.tril(self._P[index[:, :, None], index[:, None, :]])
        return np.asarray(lower + np.swapaxes(np.tril(lower, -1), 1, 2))

    def set_head(self, columns: FloatArray) -> None:
        """Replace the first columns by (n, rows), as the time update does."""
        self._P[: self.size, : columns.shape[1]] = columns

    def cross_covariance(self, J_pose: FloatArray, J_point: FloatArray, rows: IndexArray) -> FloatArray:
        """``P H'`` (capacity, 3 m) of m observations of a pose (head of the state) and of the point at ``rows`` (m,)
        each.
        """
        out = np.zeros((self.capacity, 3 * len(rows)), order="F")
        core = np.asfortranarray(self.head(6))
        _cross_covariance(self._P, self.size, core, J_pose, J_point, np.asarray(rows, dtype=np.int64), out)
        return out

    def subtract_square(self, W: FloatArray) -> None:
        """``P <- P - W W'`` (Eq. 6.20) for W (capacity, k), rows beyond the state zero."""
        blas.subtract_square(self._P, W)

    def add_product(self, A: FloatArray, B: FloatArray) -> None:
        """``P <- P + A B' + B A'`` for A, B (capacity, k), rows beyond the state zero."""
        blas.add_product(self._P, np.asfortranarray(A), np.asfortranarray(B))

    def append(self, cross: FloatArray, block: FloatArray) -> None:
        """Add rows: their covariance with the state, ``cross`` (k, n), and among themselves, ``block`` (k, k) (Eq.
        6.23).
        """
        n, k = self.size, len(block)
        self._reserve(n + k)
        self._P[n : n + k, :n] = cross
        self._P[n : n + k, n : n + k] = block
        self.size = n + k

    def remove(self, first: int, width: int) -> None:
        """Drop rows ``first .. first + width`` (marginalise); the last ``width`` rows of the state move into their
        place.
        """
        last = self.size - width
        if first != last:
            moved = self.columns(np.arange(last, self.size))[:last]
            own = self.blocks(np.array([last]), width)[0]
            self._P[first : first + width, :first] = moved[:first].T
            self._P[first : first + width, first : first + width] = own
            self._P[first + width : last, first : first + width] = moved[first + width :]
        self._P[last : self.size, : self.size] = 0.0
        self.size = last

    def _reserve(self, rows: int) -> None:
        if rows <= self.capacity:
            return
        grown = np.zeros((-(-rows // _GROWTH) * _GROWTH,) * 2, order="F")
        grown[: self.size, : self.size] = self._P[: self.size, : self.size]
        self._P = grown


def whiten(S: FloatArray, cross: FloatArray, innovation: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Cholesky form of the update (Eqs. 6.17-6.19).

    Parameters
    ----------
    S
        Innovation covariance (k, k), lower triangle used.
    cross
        ``P H'`` (capacity, k), overwritten.
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
