# SPDX-License-Identifier: Apache-2.0
"""BLAS and LAPACK routines that let other threads run meanwhile.

``scipy.linalg.blas`` holds the global interpreter lock while it computes, which stops every other thread of the process
for the length of a matrix product. The same routines, of the same library, are called here by their addresses
(``scipy.linalg.cython_blas`` exports them), and ``ctypes`` gives the lock away. All matrices are float64 in Fortran
order, or leading rows and columns of such; only lower triangles are read and written.
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_char, c_double, c_int, c_void_p
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from slam_core.geometry import FloatArray

_LOWER, _PLAIN = c_char(b"L"), c_char(b"N")


def address_of(module: Any, name: str) -> int:
    """Address of a routine that a Cython module exports."""
    capsule = module.__pyx_capi__[name]
    get_name, get_pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer.restype, get_pointer.argtypes = c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return int(get_pointer(capsule, get_name(capsule)))


def _routine(module: Any, name: str, arguments: int) -> Any:
    """A routine all of whose arguments are pointers, as in Fortran."""
    return ctypes.CFUNCTYPE(None, *[c_void_p] * arguments)(address_of(module, name))


_dsyrk = _routine(cython_blas, "dsyrk", 10)
_dsyr2k = _routine(cython_blas, "dsyr2k", 12)
_dpotrf = _routine(cython_lapack, "dpotrf", 5)
_dpotri = _routine(cython_lapack, "dpotri", 5)


def _pointer(matrix: FloatArray) -> c_void_p:
    return c_void_p(matrix.ctypes.data)


def _stride(matrix: FloatArray) -> Any:
    """From one column to the next, in numbers."""
    rows, columns = matrix.shape
    step, stride = (s // matrix.itemsize for s in matrix.strides)
    if matrix.dtype != np.float64 or (rows > 1 and step != 1) or (columns > 1 and stride < rows):
        raise ValueError(f"BLAS needs float64 in Fortran order, got {matrix.dtype} with strides {matrix.strides}")
    return byref(c_int(max(stride, rows, 1)))


def subtract_square(C: FloatArray, A: FloatArray) -> None:
    """``C <- C - A A'`` for C (n, n), A (n, k)."""
    n, k = A.shape
    alpha, beta = c_double(-1.0), c_double(1.0)
    _dsyrk(
        byref(_LOWER),
        byref(_PLAIN),
        byref(c_int(n)),
        byref(c_int(k)),
        byref(alpha),
        _pointer(A),
        _stride(A),
        byref(beta),
        _pointer(C),
        _stride(C),
    )


def add_product(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """``C <- C + A B' + B A'`` for C (n, n), A and B (n, k)."""
    n, k = A.shape
    one = c_double(1.0)
    _dsyr2k(
        byref(_LOWER), byref(_PLAIN), byref(c_int(n)), byref(c_int(k)), byref(one), _pointer(A), _stride(A),
        _pointer(B), _stride(B), byref(one), _pointer(C), _stride(C),
    )  # fmt: skip


def cholesky(S: FloatArray) -> bool:
    """``S <- L`` with S = L L' in the lower triangle; False, with S spoilt, if S is not positive definite."""
    failed = c_int(0)
    _dpotrf(byref(_LOWER), byref(c_int(len(S))), _pointer(S), _stride(S), byref(failed))
    return failed.value == 0


def inverse(S: FloatArray) -> FloatArray:
    """Inverse (n, n) of a symmetric positive definite matrix, exactly symmetric; half the work of ``np.linalg.inv``.

    Raises
    ------
    np.linalg.LinAlgError
        If S is not positive definite.
    """
    A, failed = np.array(S, dtype=np.float64, order="F"), c_int(0)
    if not cholesky(A):
        raise np.linalg.LinAlgError("matrix is not positive definite")
    _dpotri(byref(_LOWER), byref(c_int(len(A))), _pointer(A), _stride(A), byref(failed))
    lower = np.tril(A)
    return np.asarray(lower + np.tril(A, -1).T)
