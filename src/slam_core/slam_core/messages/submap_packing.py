# SPDX-License-Identifier: Apache-2.0
"""A submap's Gaussian as one matrix; Gaussian and descriptors compact, in half the bytes.

In full, the lower triangle of the covariance goes out in 64 bits. Compact, its Cholesky factor goes out in 32 bits:
whatever rounding does to a factor, factor times transpose is positive definite. Rounding changes the covariance by
about the factor's condition (rows scaled to one) times 6e-8, in units of its own standard deviations; where that could
be seen, mean and covariance go out in full.

Of a lower triangle of m rows the first half of the columns stays where it is; the others, which are shorter, stand on
their heads above the diagonal of those: m rows of m // 2 + 1 columns.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, Float32Array

Int8Array = npt.NDArray[np.int8]

MAX_ROUNDING = 1e-3
"""Largest relative change of the covariance that rounding may make."""


def full_gaussian(mean: FloatArray, covariance: FloatArray) -> AnyArray:
    """Mean (m,) in column 0, then the folded lower triangle of the covariance (m, m), float64: exact."""
    return np.column_stack([mean, _folded(np.tril(covariance))]).astype("<f8")


def pack_gaussian(mean: FloatArray, covariance: FloatArray) -> AnyArray:
    """Mean (m,) in column 0, then the folded factor, float32; where that would show, :func:`full_gaussian`."""
    try:
        L = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:  # whoever receives it can tell
        return full_gaussian(mean, covariance)
    if np.finfo(np.float32).eps * _condition(L, covariance) > MAX_ROUNDING:
        return full_gaussian(mean, covariance)
    return np.column_stack([mean, _folded(L)]).astype("<f4")


def _condition(L: FloatArray, covariance: FloatArray) -> float:
    """Condition of a factor whose rows are scaled to one, as LAPACK estimates it from the correlations."""
    from scipy.linalg.lapack import dpocon  # 0.2 s, which programs that pack nothing need not spend

    sigma = np.sqrt(np.diag(covariance))
    norm = float(np.abs(covariance / np.outer(sigma, sigma)).sum(axis=0).max())
    inverse, _ = dpocon(L / sigma[:, None], norm, uplo="L")
    return float(1.0 / np.sqrt(max(inverse, np.finfo(np.float64).tiny)))


def unpack_gaussian(packed: AnyArray) -> tuple[FloatArray, FloatArray]:
    """Mean (m,) and covariance (m, m) of what either of the two made.

    Raises
    ------
    ValueError
        If type and shape are of neither form, or if a number is not finite.
    """
    m, columns = packed.shape
    if columns != 2 + m // 2 or packed.dtype not in (np.float32, np.float64):
        raise ValueError(
            f"submap/gaussian of {m} rows must be 32FC1 or 64FC1 of {2 + m // 2} columns, "
            f"got {packed.dtype} of {columns}"
        )
    if not np.isfinite(packed).all():
        raise ValueError("submap/gaussian contains numbers that are not finite")
    exact = packed.astype(np.float64)
    L = _unfolded(exact[:, 1:])
    covariance = L @ L.T if packed.dtype == np.float32 else L + np.tril(L, -1).T
    return exact[:, 0].copy(), covariance


def _folded(L: FloatArray) -> FloatArray:
    m, width = len(L), len(L) // 2 + 1
    folded = L[:, :width].copy()
    for length in range(1, m - width + 1):
        folded[:length, length] = L[m - length :, m - length]
    return folded


def _unfolded(folded: FloatArray) -> FloatArray:
    m, width = folded.shape
    L = np.zeros((m, m))
    L[:, :width] = np.tril(folded)
    for length in range(1, m - width + 1):
        L[m - length :, m - length] = folded[:length, length]
    return L


def pack_descriptors(descriptors: Float32Array) -> Int8Array:
    """Unit descriptors (n, d) as multiples of a step of each row's own: the largest element is 127 steps."""
    largest = np.abs(descriptors).max(axis=1, keepdims=True, initial=np.finfo(np.float32).tiny)
    return np.asarray(np.rint(127.0 * (descriptors / largest)), dtype=np.int8)


def unpack_descriptors(packed: AnyArray) -> Float32Array:
    """Unit descriptors (n, d); what was sent as 32FC1 is taken as it is."""
    if packed.dtype != np.int8:
        return np.asarray(packed, dtype=np.float32)
    steps = packed.astype(np.float32)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps / np.maximum(length, 1.0), dtype=np.float32)
