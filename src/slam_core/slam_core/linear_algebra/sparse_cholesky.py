# SPDX-License-Identifier: Apache-2.0
"""Sparse Cholesky factors of symmetric positive definite block matrices: order, factor, solve, entries of the inverse.

Backends, chosen by name: ``multifrontal`` (:mod:`slam_core.linear_algebra.multifrontal`, which ``auto`` takes),
``cholmod`` (supernodal, from the cvxopt wheel; Chen, Davis, Hager and Rajamanickam 2008) and ``superlu`` (from
SciPy). The general libraries spend as long on the analysis of single unknowns as on the factor, which the blocks
spare; they stay as oracles and for comparison. Fill is reduced beforehand by :func:`elimination_order` on the graph
of the blocks; CHOLMOD may improve on it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numba
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import BlockPattern, IntArray
from slam_core.linear_algebra.elimination_tree import analyze, factor_work
from slam_core.linear_algebra.multifrontal import Multifrontal

try:
    import cvxopt
    import cvxopt.amd
    import cvxopt.cholmod
except ImportError:  # pragma: no cover - the wheel is a requirement; a distribution without it still runs
    cvxopt = None

__all__ = ["BACKENDS", "Entries", "IntArray", "SparseCholesky", "available_backend", "elimination_order", "takahashi"]

BACKENDS = ("auto", "multifrontal", "cholmod", "superlu")


def available_backend(name: str) -> str:
    """The backend that ``name`` stands for here.

    Raises
    ------
    ValueError
        For an unknown name, or ``cholmod`` without cvxopt.
    """
    if name not in BACKENDS:
        raise ValueError(f"solver backend must be one of {', '.join(BACKENDS)}, got {name!r}")
    if name == "cholmod" and cvxopt is None:
        raise ValueError("solver backend 'cholmod' needs the package cvxopt")
    return "multifrontal" if name == "auto" else name


def elimination_order(count: int, rows: IntArray, columns: IntArray) -> IntArray:
    """Fill-reducing order of the ``count`` nodes of an undirected graph with edges (rows[i], columns[i]).

    Approximate minimum degree (Amestoy, Davis and Duff 1996) where cvxopt is there, SuperLU's multiple minimum degree
    otherwise. Entry ``k`` of the result is the node that is eliminated k-th.
    """
    apart = rows != columns
    low, high = np.minimum(rows, columns)[apart], np.maximum(rows, columns)[apart]
    # Sorted and unique: cvxopt inserts entries that come otherwise one by one.
    edges = np.unique(np.concatenate([low * count + high, np.arange(count, dtype=np.int64) * (count + 1)]))
    if cvxopt is None:
        half = scipy.sparse.coo_matrix((np.ones(len(edges)), (edges % count, edges // count)), (count, count))
        graph = (half + half.T + 2 * count * scipy.sparse.eye(count)).tocsc()
        place = scipy.sparse.linalg.splu(graph, "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True}).perm_c
        return np.argsort(place).astype(np.int64)
    pattern = _spmatrix(count, edges % count, edges // count)
    return np.array(cvxopt.amd.order(pattern), dtype=np.int64).ravel()


def _spmatrix(n: int, rows: IntArray, columns: IntArray) -> Any:
    return cvxopt.spmatrix(1.0, cvxopt.matrix(rows), cvxopt.matrix(columns), (n, n))


class Entries(Protocol):
    """Entries of an inverse inside a factor's pattern."""

    def block(self, variables: IntArray) -> FloatArray:
        """Dense block (k, k) of the inverse for ``variables``; ``KeyError`` where a pair is outside the pattern."""


class _Backend(Protocol):
    def factorize(self, values: FloatArray) -> bool: ...

    def solve(self, rhs: FloatArray) -> FloatArray: ...

    def inverse_block(self, variables: IntArray) -> FloatArray: ...

    def marginal_information(self, variables: IntArray) -> FloatArray: ...

    def inverse_entries(self) -> Entries: ...


class _Library(ABC):
    """Common part of the backends from libraries: they know single unknowns only."""

    def __init__(self, pattern: BlockPattern) -> None:
        self._n = pattern.n
        rows, columns = pattern.scalar_entries()
        self._kept = np.nonzero(rows >= columns)[0]
        self._rows, self._columns = rows[self._kept], columns[self._kept]

    @abstractmethod
    def solve(self, rhs: FloatArray) -> FloatArray:
        """``A^-1 rhs`` with the last factor."""

    @abstractmethod
    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]:
        """``L`` and ``p`` with ``A[p][:, p] = L L^T`` of the last factor."""

    def inverse_block(self, variables: IntArray) -> FloatArray:
        unit = np.zeros((self._n, len(variables)))
        unit[variables, np.arange(len(variables))] = 1.0
        return self.solve(unit)[variables]

    def marginal_information(self, variables: IntArray) -> FloatArray:
        return np.asarray(np.linalg.inv(self.inverse_block(variables)))

    def inverse_entries(self) -> Entries:
        factor, order = self.lower()
        indptr, indices = factor.indptr.astype(np.int64), factor.indices.astype(np.int64)
        values = takahashi(indptr, indices, factor.data)
        position = np.empty_like(order)
        position[order] = np.arange(len(order))
        return InverseEntries(indptr, indices, values, position)


class _Cholmod(_Library):
    def __init__(self, pattern: BlockPattern) -> None:
        super().__init__(pattern)
        self._matrix = _spmatrix(pattern.n, self._rows, self._columns)
        self._natural = cvxopt.matrix(np.arange(pattern.n, dtype=np.int64))
        self._factor = cvxopt.cholmod.symbolic(self._matrix, self._natural)
        self._exported = False

    def factorize(self, values: FloatArray) -> bool:
        self._matrix.V = cvxopt.matrix(values[self._kept])
        return self._refactorize()

    def _refactorize(self) -> bool:
        if self._exported:  # an exported factor is spent: neither its values nor its symbolic part can be used again
            self._factor = cvxopt.cholmod.symbolic(self._matrix, self._natural)
            self._exported = False
        try:
            cvxopt.cholmod.numeric(self._matrix, self._factor)
        except ArithmeticError:
            return False
        return True

    def solve(self, rhs: FloatArray) -> FloatArray:
        if self._exported:
            self._refactorize()
        x = cvxopt.matrix(np.ascontiguousarray(rhs.T).T if rhs.ndim == 2 else rhs)
        cvxopt.cholmod.solve(self._factor, x)
        return np.array(x).reshape(rhs.shape)

    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]:
        if self._exported:
            self._refactorize()
        permutation = cvxopt.matrix(np.arange(self._n, dtype=np.float64))
        cvxopt.cholmod.solve(self._factor, permutation, sys=7)
        order = np.array(permutation).ravel().astype(np.int64)
        factor = cvxopt.cholmod.getfactor(self._factor)
        self._exported = True
        indptr, indices, data = (np.array(part).ravel() for part in factor.CCS)
        return scipy.sparse.csc_matrix((data, indices, indptr), (self._n, self._n)), order


class _SuperLu(_Library):
    def __init__(self, pattern: BlockPattern) -> None:
        super().__init__(pattern)
        rows, columns = self._rows, self._columns
        self._mirrored = np.nonzero(rows > columns)[0]
        self._rows = np.concatenate([rows, columns[self._mirrored]])
        self._columns = np.concatenate([columns, rows[self._mirrored]])
        self._factor: Any = None

    def factorize(self, values: FloatArray) -> bool:
        kept = values[self._kept]
        data = np.concatenate([kept, kept[self._mirrored]])
        matrix = scipy.sparse.csc_matrix((data, (self._rows, self._columns)), (self._n, self._n))
        try:
            self._factor = scipy.sparse.linalg.splu(
                matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:  # exactly singular
            return False
        return bool(np.all(self._factor.U.diagonal() > 0.0))

    def solve(self, rhs: FloatArray) -> FloatArray:
        return np.asarray(self._factor.solve(np.asarray(rhs)))

    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]:
        # Without row exchanges A = L D L^T with D the diagonal of U.
        scale = scipy.sparse.diags(np.sqrt(self._factor.U.diagonal()))
        factor = scipy.sparse.csc_matrix(self._factor.L @ scale)
        factor.sort_indices()
        order = np.empty(self._n, dtype=np.int64)
        order[self._factor.perm_r] = np.arange(self._n)
        return factor, order


class SparseCholesky:
    """Factor of matrices that share one sparsity pattern: the symbolic work is done once.

    Parameters
    ----------
    pattern
        Where the lower triangle may differ from zero, in an order that keeps the fill low.
    backend
        One of :data:`BACKENDS`.
    """

    def __init__(self, pattern: BlockPattern, backend: str = "auto") -> None:
        self.pattern = pattern
        self.backend = available_backend(backend)
        self._impl = _IMPLEMENTATIONS[self.backend](pattern)

    @property
    def work(self) -> float:
        """Multiplications of a factorisation in this order."""
        return factor_work(self._impl.symbolic if isinstance(self._impl, Multifrontal) else analyze(self.pattern))

    def factorize(self, values: FloatArray) -> bool:
        """Factor the matrix with these entries (in the order of the pattern); False if not positive definite."""
        return bool(np.all(np.isfinite(values))) and self._impl.factorize(values)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """``A^-1 rhs`` with the last factor; rhs (n,) or (n, k)."""
        return self._impl.solve(np.asarray(rhs, dtype=np.float64))

    def inverse_block(self, variables: IntArray) -> FloatArray:
        """Dense block (k, k) of ``A^-1`` for any variables, with the last factor."""
        block = self._impl.inverse_block(np.asarray(variables, dtype=np.int64))
        return 0.5 * (block + block.T)

    def marginal_information(self, variables: IntArray) -> FloatArray:
        """Inverse (k, k) of that block of ``A^-1``, for variables that are eliminated after all others."""
        information = self._impl.marginal_information(np.asarray(variables, dtype=np.int64))
        return 0.5 * (information + information.T)

    def inverse_entries(self) -> Entries:
        """Exact entries of ``A^-1`` inside the factor's pattern (Takahashi, Fagan and Chin 1973)."""
        return self._impl.inverse_entries()


_IMPLEMENTATIONS: dict[str, Callable[[BlockPattern], _Backend]] = {
    "multifrontal": Multifrontal,
    "cholmod": _Cholmod,
    "superlu": _SuperLu,
}


@dataclass(frozen=True, eq=False)
class InverseEntries:
    """Entries of an inverse inside a factor's pattern; ``position`` maps a variable to its column of the factor."""

    indptr: IntArray
    indices: IntArray
    values: FloatArray
    position: IntArray

    def block(self, variables: IntArray) -> FloatArray:
        """Dense block (k, k) of the inverse for ``variables``; every pair must lie inside the pattern.

        Raises
        ------
        KeyError
            If a pair lies outside; ask the factor for the columns instead.
        """
        block: FloatArray = _gather_block(self.indptr, self.indices, self.values, self.position[variables])
        if np.isnan(block).any():
            raise KeyError("inverse entries outside the factor's pattern")
        return block


@numba.njit(cache=True, nogil=True)
def takahashi(indptr, indices, data):  # type: ignore[no-untyped-def]
    """Entries of ``(L L^T)^-1`` at the nonzeros of L (CSC, rows ascending, diagonal first).

    From the last columns back, a supernode (columns J of equal pattern, rows I below) at a time: with
    ``Y = L_IJ L_JJ^-1`` the inverse has ``Z_IJ = -Z_II Y`` and ``Z_JJ = L_JJ^-T L_JJ^-1 - Y^T Z_IJ``; ``Z_II`` is
    known.
    """
    n = len(indptr) - 1
    out = np.zeros_like(data)
    slot = np.full(n, -1, dtype=np.int64)
    last = n
    while last > 0:
        first = last - 1
        while first > 0 and last - first < 64 and _continues(indptr, indices, first):
            first -= 1
        w = last - first
        rows = indices[indptr[first] + w : indptr[first + 1]]
        h = len(rows)
        Z = _gather_square(indptr, indices, out, rows, slot)
        top, below = np.zeros((w, w)), np.zeros((h, w))
        for j in range(w):
            start = indptr[first + j]
            top[j:, j] = data[start : start + w - j]
            below[:, j] = data[start + w - j : indptr[first + j + 1]]
        inverse = np.linalg.inv(top)
        Y = np.dot(below, inverse)
        Z_IJ = -np.dot(Z, Y)
        Z_JJ = np.dot(inverse.T.copy(), inverse) - np.dot(Y.T.copy(), Z_IJ)
        for j in range(w):
            start = indptr[first + j]
            out[start : start + w - j] = Z_JJ[j:, j]
            out[start + w - j : indptr[first + j + 1]] = Z_IJ[:, j]
        last = first
    return out


@numba.njit(cache=True, nogil=True)
def _gather_square(indptr, indices, values, rows, slot):  # type: ignore[no-untyped-def]
    """Symmetric (h, h) of the entries in ``rows`` and their columns; ``slot`` is all -1 before and after."""
    Z = np.zeros((len(rows), len(rows)))
    for k in range(len(rows)):
        slot[rows[k]] = k
    for k in range(len(rows)):
        for p in range(indptr[rows[k]], indptr[rows[k] + 1]):
            s = slot[indices[p]]
            if s >= 0:
                Z[s, k] = values[p]
                Z[k, s] = values[p]
    slot[rows] = -1
    return Z


@numba.njit(cache=True, nogil=True)
def _continues(indptr, indices, column):  # type: ignore[no-untyped-def]
    """True if the column before ``column`` has the same pattern, itself added; in a factor its size and parent tell."""
    before = column - 1
    same_size = indptr[column] - indptr[before] == indptr[column + 1] - indptr[column] + 1
    return same_size and indices[indptr[before] + 1] == column


@numba.njit(cache=True, nogil=True)
def _gather_block(indptr, indices, values, positions):  # type: ignore[no-untyped-def]
    n = len(positions)
    out = np.full((n, n), np.nan)
    for a in range(n):
        column = positions[a]
        rows = indices[indptr[column] : indptr[column + 1]]
        for b in range(n):
            row = positions[b]
            if row >= column:
                p = np.searchsorted(rows, row)
                if p < len(rows) and rows[p] == row:
                    out[a, b] = out[b, a] = values[indptr[column] + p]
    return out
