# SPDX-License-Identifier: Apache-2.0
"""A joint Gaussian of one pose and many landmarks in a few hundred bytes, never surer than the one it stands for.

    covariance = B (U U' + t D) B',    D = I - blocks of U U'

``B`` holds the Cholesky factor of each unknown's own block (6 x 6 of the pose, 3 x 3 of a landmark), so that the
whitened covariance has identity blocks. ``U`` (m, r) is what unknowns have in common, by factor analysis: a submap's
landmarks err together because the rig's poses between them do, and a few of these directions carry nearly all of it.
``D`` is what each has by itself; it follows from ``U``. Numbers are rounded first, ``t`` is chosen last: the least
factor for which the difference to the given covariance is positive semidefinite. Whatever is left out or rounded
can therefore only make the Gaussian less sure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray

Int8Array = npt.NDArray[np.int8]
Float16Array = npt.NDArray[np.float16]

UNIT = 1e-3
"""Blocks are sent in mm and mrad."""
_ITERATIONS = 2
_LEAST_OWN = 2e-3
"""Least share of an unknown's variance that is taken as its own: keeps ``D`` invertible."""
_STEPS = 127.0
_MARGIN = 1.0 + 1e-6
"""The factor ``t`` is enlarged by the rounding of the sum that it is checked with."""


@dataclass(frozen=True, eq=False)
class CompactGaussian:
    """A covariance as it is sent: ``blocks`` (21 + 6n,) of B in mm and mrad, ``common`` (6 + 3n, r) of U, and t."""

    blocks: Float16Array
    common: Int8Array
    inflation: float

    def covariance(self) -> FloatArray:
        """The covariance (6 + 3n, 6 + 3n), positive definite."""
        U = self.common.astype(np.float64) / _STEPS
        return _factors(self.blocks).between(_sum(U @ U.T, self.inflation, _own(U)))

    def end_covariance(self) -> FloatArray:
        """The pose's own covariance (6, 6)."""
        return CompactGaussian(self.blocks[:21], self.common[:6], self.inflation).covariance()


def compact_gaussian(covariance: FloatArray, rank: int, rounding: float = 0.0) -> CompactGaussian:
    """The Gaussian of a pose and n landmarks with ``rank`` common directions.

    Parameters
    ----------
    covariance
        Shape (6 + 3n, 6 + 3n), positive definite, m and rad.
    rank
        Number of common directions.
    rounding
        Largest error (m) made by rounding the landmarks' positions; its square is added to their variances.

    Raises
    ------
    ValueError
        If the covariance is not positive definite, or too large for the format (65 m).
    """
    S = covariance.copy()
    rows = np.arange(6, len(S))
    S[rows, rows] += rounding**2
    blocks = _rounded_factors(S)
    whitened = _factors(blocks).inverse().between(S)
    U = _common_directions(whitened, min(rank, len(S) - 1))
    rounded = np.clip(np.rint(_STEPS * U), -_STEPS, _STEPS).astype(np.int8)
    U = rounded.astype(np.float64) / _STEPS
    excess = _own(U).cholesky().inverse().between(whitened - U @ U.T)
    inflation = max(1.0, float(np.linalg.eigvalsh(excess)[-1]))
    return CompactGaussian(blocks, rounded, float(np.nextafter(np.float32(inflation * _MARGIN), np.float32(np.inf))))


class _Blocks(NamedTuple):
    """A block-diagonal matrix: the pose's block (6, 6) and the landmarks' (n, 3, 3)."""

    pose: FloatArray
    landmarks: FloatArray

    @classmethod
    def of(cls, S: FloatArray) -> _Blocks:
        """The blocks of a matrix (6 + 3n, 6 + 3n)."""
        n = (len(S) - 6) // 3
        return cls(S[:6, :6], S[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])

    def cholesky(self) -> _Blocks:
        """Cholesky factors of the blocks."""
        return self._mapped(np.linalg.cholesky)

    def inverse(self) -> _Blocks:
        """Inverses of the blocks."""
        return self._mapped(np.linalg.inv)

    def _mapped(self, function: Callable[[FloatArray], Any]) -> _Blocks:
        return _Blocks(function(self.pose), function(self.landmarks))

    def times(self, M: FloatArray) -> FloatArray:
        """The product with a matrix (6 + 3n, k)."""
        n, k = len(self.landmarks), M.shape[1]
        return np.concatenate([self.pose @ M[:6], (self.landmarks @ M[6:].reshape(n, 3, k)).reshape(3 * n, k)])

    def between(self, S: FloatArray) -> FloatArray:
        """A S A' for this matrix A and a symmetric one (6 + 3n, 6 + 3n)."""
        W = self.times(self.times(S).T)
        return np.asarray(0.5 * (W + W.T))


def _sum(S: FloatArray, factor: float, blocks: _Blocks) -> FloatArray:
    """S + factor * blocks; S is changed."""
    S[:6, :6] += factor * blocks.pose
    for k, block in enumerate(blocks.landmarks):
        S[6 + 3 * k : 9 + 3 * k, 6 + 3 * k : 9 + 3 * k] += factor * block
    return S


def _rounded_factors(S: FloatArray) -> Float16Array:
    """Lower triangles of the blocks' Cholesky factors in mm and mrad, the pose's first."""
    try:
        B = _Blocks.of(S).cholesky()
    except np.linalg.LinAlgError as error:
        raise ValueError("a submap's covariance must be positive definite") from error
    rows, columns = np.tril_indices(3)
    values = np.concatenate([B.pose[np.tril_indices(6)], B.landmarks[:, rows, columns].ravel()]) / UNIT
    if not np.abs(values).max() < np.finfo(np.float16).max:
        raise ValueError(f"a standard deviation of {UNIT * np.abs(values).max():.3g} m is too large to be sent")
    return np.asarray(values, dtype=np.float16)


def _factors(blocks: Float16Array) -> _Blocks:
    """Inverse of :func:`_rounded_factors`."""
    values = UNIT * blocks.astype(np.float64)
    B = _Blocks(np.zeros((6, 6)), np.zeros(((len(values) - 21) // 6, 3, 3)))
    B.pose[np.tril_indices(6)] = values[:21]
    rows, columns = np.tril_indices(3)
    B.landmarks[:, rows, columns] = values[21:].reshape(-1, 6)
    return B


def _own(U: FloatArray) -> _Blocks:
    """I less the blocks of U U', with eigenvalues of at least ``_LEAST_OWN``."""
    V = U[6:].reshape(-1, 3, U.shape[1])
    return _Blocks(_floored(np.eye(6) - U[:6] @ U[:6].T), _floored(np.eye(3) - V @ V.transpose(0, 2, 1)))


def _floored(blocks: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(blocks)
    return np.asarray((vectors * np.maximum(values, _LEAST_OWN)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _common_directions(C: FloatArray, rank: int) -> FloatArray:
    """Factor analysis of a covariance with identity blocks: U (m, rank) by alternating between U and D."""
    from scipy.linalg import eigh  # its own half second, which receivers need not spend

    m = len(C)
    U, D = np.zeros((m, rank)), _Blocks(0.5 * np.eye(6), np.tile(0.5 * np.eye(3), ((m - 6) // 3, 1, 1)))
    for _ in range(_ITERATIONS):
        L = D.cholesky()
        values, vectors = eigh(L.inverse().between(C), subset_by_index=(m - rank, m - 1))
        U = L.times(vectors * np.sqrt(np.maximum(values - 1.0, 0.0)))
        D = _own(U)
    return np.asarray(U)
