"""Sparse Cholesky factors of symmetric positive definite matrices: order, factor, solve, and exact entries of the
inverse.

Backends, chosen by name: ``cholmod`` (supernodal, from the cvxopt wheel; Chen, Davis, Hager and Rajamanickam 2008),
``superlu`` (from SciPy, always there) and ``lapack`` (dense); ``auto`` takes LAPACK for a matrix that is nearly full,
as small maps are, and else the first of the others that is there. Fill is reduced beforehand by
:func:`elimination_order` on the graph of the *blocks*, which is much smaller than the matrix; CHOLMOD may improve on
it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numba
import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from slam_core.geometry import FloatArray

try:
    import cvxopt
    import cvxopt.amd
    import cvxopt.cholmod
except ImportError:  # pragma: no cover - the wheel is a requirement; a distribution without it still runs
    cvxopt = None

IntArray = npt.NDArray[np.int64]
BACKENDS = ("auto", "cholmod", "superlu", "lapack")
_FULL = 0.25
"""Share of stored entries from which a dense factor takes less time than a sparse one."""


def available_backend(name: str) -> str:
    """The backend that ``name`` stands for here: ``auto`` takes CHOLMOD where cvxopt is installed.

    Raises
    ------
    ValueError
        For an unknown name, or ``cholmod`` without cvxopt.
    """
    if name not in BACKENDS:
        raise ValueError(f"solver backend must be one of {', '.join(BACKENDS)}, got {name!r}")
    if name == "cholmod" and cvxopt is None:
        raise ValueError("solver backend 'cholmod' needs the package cvxopt")
    return name if name != "auto" else ("superlu" if cvxopt is None else "cholmod")


def elimination_order(count: int, rows: IntArray, columns: IntArray) -> IntArray:
    """Fill-reducing order of the ``count`` nodes of an undirected graph with edges (rows[i], columns[i]).

    Approximate minimum degree (Amestoy, Davis and Duff 1996) where cvxopt is there, reverse Cuthill-McKee otherwise.
    Entry ``k`` of the result is the node that is eliminated k-th.
    """
    if cvxopt is None:
        graph = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
        return np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(graph + graph.T, True), dtype=np.int64)
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    # Sorted and unique: cvxopt inserts entries that come otherwise one by one.
    edges = np.unique(np.concatenate([low * count + high, np.arange(count, dtype=np.int64) * (count + 1)]))
    pattern = _spmatrix(count, edges % count, edges // count)
    return np.array(cvxopt.amd.order(pattern), dtype=np.int64).ravel()


def _spmatrix(n: int, rows: IntArray, columns: IntArray) -> Any:
    return cvxopt.spmatrix(1.0, cvxopt.matrix(rows), cvxopt.matrix(columns), (n, n))


@dataclass(frozen=True, eq=False)
class Pattern:
    """Lower triangle of a symmetric matrix in compressed columns: ``indptr`` (n + 1,), ``indices`` (nnz,) rows
    ascending.

    Entries above the diagonal may be stored (whole diagonal blocks are simpler to fill); they are ignored.
    """

    n: int
    indptr: IntArray
    indices: IntArray

    @property
    def columns(self) -> IntArray:
        """Column of every stored entry, shape (nnz,)."""
        return np.repeat(np.arange(self.n, dtype=np.int64), np.diff(self.indptr))


class _Backend(Protocol):
    def factorize(self, values: FloatArray) -> bool: ...

    def solve(self, rhs: FloatArray) -> FloatArray: ...

    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]: ...


class _Cholmod:
    def __init__(self, pattern: Pattern) -> None:
        self._matrix = _spmatrix(pattern.n, pattern.indices, pattern.columns)
        self._natural = cvxopt.matrix(np.arange(pattern.n, dtype=np.int64))
        self._factor = cvxopt.cholmod.symbolic(self._matrix, self._natural)
        self._exported = False

    def factorize(self, values: FloatArray) -> bool:
        self._matrix.V = cvxopt.matrix(values)
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
        n = self._matrix.size[0]
        permutation = cvxopt.matrix(np.arange(n, dtype=np.float64))
        cvxopt.cholmod.solve(self._factor, permutation, sys=7)
        order = np.array(permutation).ravel().astype(np.int64)
        factor = cvxopt.cholmod.getfactor(self._factor)
        self._exported = True
        indptr, indices, data = (np.array(part).ravel() for part in factor.CCS)
        return scipy.sparse.csc_matrix((data, indices, indptr), (n, n)), order


class _SuperLu:
    def __init__(self, pattern: Pattern) -> None:
        rows, columns = pattern.indices, pattern.columns
        self._kept = np.nonzero(rows >= columns)[0]
        rows, columns = rows[self._kept], columns[self._kept]
        self._mirrored = np.nonzero(rows > columns)[0]
        self._rows = np.concatenate([rows, columns[self._mirrored]])
        self._columns = np.concatenate([columns, rows[self._mirrored]])
        self._n = pattern.n
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


class _Lapack:
    """Dense factor in place; only the lower triangle is read and written."""

    def __init__(self, pattern: Pattern) -> None:
        self._pattern = pattern
        self._matrix = np.zeros((pattern.n, pattern.n), order="F")
        self._at = pattern.columns * pattern.n + pattern.indices

    def factorize(self, values: FloatArray) -> bool:
        self._matrix[...] = 0.0
        self._matrix.ravel(order="K")[self._at] = values
        _, fault = scipy.linalg.lapack.dpotrf(self._matrix, lower=True, clean=False, overwrite_a=True)
        return bool(fault == 0)

    def solve(self, rhs: FloatArray) -> FloatArray:
        return np.asarray(scipy.linalg.cho_solve((self._matrix, True), rhs, check_finite=False))

    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]:
        n = self._pattern.n
        columns, rows = np.triu_indices(n)
        indptr = np.concatenate([[0], np.cumsum(np.arange(n, 0, -1))])
        return scipy.sparse.csc_matrix((self._matrix[rows, columns], rows, indptr), (n, n)), np.arange(n)


class SparseCholesky:
    """Factor of matrices that share one sparsity pattern: the symbolic work is done once.

    Parameters
    ----------
    pattern
        Where the lower triangle may differ from zero, in an order that keeps the fill low.
    backend
        One of :data:`BACKENDS`.
    """

    def __init__(self, pattern: Pattern, backend: str = "auto") -> None:
        self.pattern = pattern
        self.backend = available_backend(backend)
        if backend == "auto" and len(pattern.indices) > _FULL * pattern.n**2:
            self.backend = "lapack"
        self._impl = _IMPLEMENTATIONS[self.backend](pattern)

    def factorize(self, values: FloatArray) -> bool:
        """Factor the matrix with these entries (in the order of the pattern); False if not positive definite."""
        return bool(np.all(np.isfinite(values))) and self._impl.factorize(values)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """``A^-1 rhs`` with the last factor; rhs (n,) or (n, k)."""
        return self._impl.solve(np.asarray(rhs, dtype=np.float64))

    def lower(self) -> tuple[scipy.sparse.csc_matrix, IntArray]:
        """``L`` and ``p`` with ``A[p][:, p] = L L^T`` of the last factor."""
        return self._impl.lower()

    def inverse_entries(self) -> InverseEntries:
        """Exact entries of ``A^-1`` inside the factor's pattern (Takahashi, Fagan and Chin 1973)."""
        factor, order = self.lower()
        indptr, indices = factor.indptr.astype(np.int64), factor.indices.astype(np.int64)
        values = takahashi(indptr, indices, factor.data)
        position = np.empty_like(order)
        position[order] = np.arange(len(order))
        return InverseEntries(indptr, indices, values, position)


_IMPLEMENTATIONS: dict[str, Callable[[Pattern], _Backend]] = {
    "cholmod": _Cholmod, "superlu": _SuperLu, "lapack": _Lapack,
}  # fmt: skip


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
        for k in range(h):
            slot[rows[k]] = k
        Z = np.zeros((h, h))
        for k in range(h):
            for p in range(indptr[rows[k]], indptr[rows[k] + 1]):
                s = slot[indices[p]]
                if s >= 0:
                    Z[s, k] = out[p]
                    Z[k, s] = out[p]
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
        for k in range(h):
            slot[rows[k]] = -1
        last = first
    return out


def ancestors(indptr: IntArray, indices: IntArray, columns: IntArray) -> IntArray:
    """These columns of a factor and all above them in its elimination tree, ascending (Liu 1990)."""
    found: set[int] = set()
    for column in columns.tolist():
        while column not in found:
            found.add(column)
            if indptr[column + 1] - indptr[column] < 2:
                break
            column = int(indices[indptr[column] + 1])
    return np.array(sorted(found), dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def _continues(indptr, indices, column):  # type: ignore[no-untyped-def]
    """Whether the column before ``column`` has the same pattern, itself added; in a factor its size and parent tell."""
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
