# SPDX-License-Identifier: Apache-2.0
"""BLAS and LAPACK inside compiled kernels, in place, where ``np.dot`` makes a new array each time.

The routines (SciPy's, see :mod:`slam_core.linear_algebra.blas`) are made known to the compiler by name, so that
kernels which call them can be cached. Matrices are float64, row by row, without gaps between the rows; of symmetric
and triangular ones the lower triangle counts. To Fortran each is its transpose, hence upper triangles in the calls.
Only :func:`whiten` and what follows it take them in Fortran order, as the filter has them.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import binding
from numba import njit, types
from scipy.linalg import cython_blas, cython_lapack

from slam_core.linear_algebra.blas import address_of

# Addresses do not keep an array alive: what is behind them are constants, or arguments, which the caller holds.
_LETTERS = np.frombuffer(b"ULTNR", dtype=np.uint8)
_UPPER, _LEFT, _TRANSPOSED, _PLAIN, _RIGHT = 0, 1, 2, 3, 4
_LOWER = _LEFT
_FACTORS = np.array([1.0, -1.0])
_BLOCK = 48
"""Columns that :func:`whiten` solves for at once."""


def _known(module: Any, name: str, arguments: int) -> Any:
    """A routine all of whose arguments are addresses, as in Fortran."""
    symbol = f"slam_core_{name}"
    binding.add_symbol(symbol, address_of(module, name))
    return types.ExternalFunction(symbol, types.void(*[types.uintp] * arguments))


_dpotrf = _known(cython_lapack, "dpotrf", 5)
_dtrsm = _known(cython_blas, "dtrsm", 11)
_dsyrk = _known(cython_blas, "dsyrk", 10)
_dsyr2k = _known(cython_blas, "dsyr2k", 12)
_dgemm = _known(cython_blas, "dgemm", 13)
_dtrtrs = _known(cython_lapack, "dtrtrs", 10)


@njit(cache=True, nogil=True)
def cholesky(A):
    """``A <- L`` with A = L L^T (n, n); False, with A spoilt, if A is not positive definite."""
    if len(A) == 0:
        return True
    sizes = _sizes(len(A), 0)
    _factorize(A, sizes)
    positive = sizes[1] == 0
    for i in range(len(A)):
        positive = positive and A[i, i] > 0.0  # not so of NaN, which some libraries let pass
    return positive


@njit(cache=True, nogil=True)
def solve_right(L, B):
    """``B <- B L^-T`` for L (k, k) lower triangular, B (n, k)."""
    if B.size > 0:
        _solve(L, B, _sizes(B.shape[1], B.shape[0]))


@njit(cache=True, nogil=True)
def subtract_square(A, C):
    """``C <- C - A A^T`` for A (n, k), C (n, n)."""
    if A.size > 0:
        _multiply(A, C, _sizes(A.shape[1], A.shape[0]))


@njit(cache=True, nogil=True)
def whiten(S, B, y):
    """``S <- L`` with S = L L^T (k, k), ``B <- B L^-T`` for B (n, k), ``y <- L^-1 y`` for y (k,).

    In Fortran order. False, with all three spoilt, if S is not positive definite.
    """
    k, n = len(S), len(B)
    sizes = np.array([k, n, 1, 0, 0, 0], np.int32)
    size, one, failed = sizes.ctypes.data, sizes[2:].ctypes.data, sizes[3:].ctypes.data
    lower, plain = _LETTERS[_LOWER:].ctypes.data, _LETTERS[_PLAIN:].ctypes.data
    _dpotrf(lower, size, S.ctypes.data, size, failed)
    if sizes[3]:
        return False
    _dtrtrs(lower, plain, plain, size, one, S.ctypes.data, size, y.ctypes.data, size, failed)
    for first in range(0, k, _BLOCK):
        sizes[4], sizes[5] = first, min(_BLOCK, k - first)
        _solve_block(S, B, first, sizes)
    return True


@njit(cache=True, nogil=True)
def _solve_block(L, B, first, sizes):
    """Solve for some columns of B, block by block: BLAS's own solution is half as fast as its products are."""
    k, n, before, own = sizes.ctypes.data, sizes[1:].ctypes.data, sizes[4:].ctypes.data, sizes[5:].ctypes.data
    plain, transposed = _LETTERS[_PLAIN:].ctypes.data, _LETTERS[_TRANSPOSED:].ctypes.data
    one, minus = _FACTORS.ctypes.data, _FACTORS[1:].ctypes.data
    out = B[:, first:].ctypes.data
    if first:
        below = L[first:].ctypes.data
        _dgemm(plain, transposed, n, own, before, minus, B.ctypes.data, n, below, k, one, out, n)
    right, lower = _LETTERS[_RIGHT:].ctypes.data, _LETTERS[_LOWER:].ctypes.data
    _dtrsm(right, lower, transposed, plain, n, own, one, L[first:, first:].ctypes.data, k, out, n)


@njit(cache=True, nogil=True)
def subtract_square_and_add_product(W, A, B, P):
    """``P <- P - W W^T + A^T B + B^T A`` for W (n, k), A and B (m, n), in the first n rows and columns of P.

    W and P in Fortran order, of P the lower triangle; A and B row by row.
    """
    n, k = W.shape
    sizes = np.array([k, n, len(A), P.strides[1] // P.itemsize], np.int32)
    count, rows, few, stride = sizes.ctypes.data, sizes[1:].ctypes.data, sizes[2:].ctypes.data, sizes[3:].ctypes.data
    lower, plain = _LETTERS[_LOWER:].ctypes.data, _LETTERS[_PLAIN:].ctypes.data
    one, minus = _FACTORS.ctypes.data, _FACTORS[1:].ctypes.data
    _dsyrk(lower, plain, rows, count, minus, W.ctypes.data, rows, one, P.ctypes.data, stride)
    _dsyr2k(lower, plain, rows, few, one, A.ctypes.data, rows, B.ctypes.data, rows, one, P.ctypes.data, stride)


@njit(cache=True, nogil=True)
def _sizes(columns, rows):
    out = np.empty(2, np.int32)
    out[0], out[1] = columns, rows
    return out


@njit(cache=True, nogil=True)
def _factorize(A, sizes):
    n = sizes.ctypes.data
    _dpotrf(_LETTERS[_UPPER:].ctypes.data, n, A.ctypes.data, n, sizes[1:].ctypes.data)


@njit(cache=True, nogil=True)
def _solve(L, B, sizes):
    k, n = sizes.ctypes.data, sizes[1:].ctypes.data
    _dtrsm(
        _LETTERS[_LEFT:].ctypes.data, _LETTERS[_UPPER:].ctypes.data, _LETTERS[_TRANSPOSED:].ctypes.data,
        _LETTERS[_PLAIN:].ctypes.data, k, n, _FACTORS.ctypes.data, L.ctypes.data, k, B.ctypes.data, k,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _multiply(A, C, sizes):
    k, n = sizes.ctypes.data, sizes[1:].ctypes.data
    _dsyrk(
        _LETTERS[_UPPER:].ctypes.data,
        _LETTERS[_TRANSPOSED:].ctypes.data,
        n,
        k,
        _FACTORS[1:].ctypes.data,
        A.ctypes.data,
        k,
        _FACTORS.ctypes.data,
        C.ctypes.data,
        n,
    )
