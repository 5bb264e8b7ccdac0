# SPDX-License-Identifier: Apache-2.0
"""BLAS and LAPACK inside compiled kernels, in place, where ``np.dot`` makes a new array each time.

The routines (SciPy's, see :mod:`slam_core.linear_algebra.blas`) are made known to the compiler by name, so that
kernels which call them can be cached. Matrices are float64, row by row, without gaps between the rows; of symmetric
and triangular ones the lower triangle counts. To Fortran each is its transpose, hence upper triangles in the calls.
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
_LETTERS = np.frombuffer(b"ULTN", dtype=np.uint8)
_UPPER, _LEFT, _TRANSPOSED, _PLAIN = 0, 1, 2, 3
_FACTORS = np.array([1.0, -1.0])


def _known(module: Any, name: str, arguments: int) -> Any:
    """A routine all of whose arguments are addresses, as in Fortran."""
    symbol = f"slam_core_{name}"
    binding.add_symbol(symbol, address_of(module, name))
    return types.ExternalFunction(symbol, types.void(*[types.uintp] * arguments))


_dpotrf = _known(cython_lapack, "dpotrf", 5)
_dtrsm = _known(cython_blas, "dtrsm", 11)
_dsyrk = _known(cython_blas, "dsyrk", 10)


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
