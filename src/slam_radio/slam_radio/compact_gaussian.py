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

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray

Int8Array = npt.NDArray[np.int8]
Float16Array = npt.NDArray[np.float16]

UNIT = 1e-3
"""Blocks are sent in mm and mrad."""
_ITERATIONS = 6
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
        B, U = _block_matrix(self.blocks, len(self.common)), self.common.astype(np.float64) / _STEPS
        return np.asarray(B @ (U @ U.T + self.inflation * _own(U)) @ B.T)


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
    blocks = _blocks(S)
    B = _block_matrix(blocks, len(S))
    whitened = _whitened(B, S)
    U = _common_directions(whitened, min(rank, len(S) - 1))
    rounded = np.clip(np.rint(_STEPS * U), -_STEPS, _STEPS).astype(np.int8)
    U = rounded.astype(np.float64) / _STEPS
    own = _block_cholesky(_own(U))
    excess = _whitened(own, whitened - U @ U.T)
    inflation = max(1.0, float(np.linalg.eigvalsh(excess)[-1]))
    return CompactGaussian(blocks, rounded, float(np.nextafter(np.float32(inflation * _MARGIN), np.float32(np.inf))))


def _slices(m: int) -> list[slice]:
    return [slice(0, 6), *(slice(k, k + 3) for k in range(6, m, 3))]


def _block_cholesky(S: FloatArray) -> FloatArray:
    out = np.zeros_like(S)
    out[:6, :6] = np.linalg.cholesky(S[:6, :6])
    small = np.linalg.cholesky(_small_blocks(S))
    for k, rows in enumerate(_slices(len(S))[1:]):
        out[rows, rows] = small[k]
    return out


def _small_blocks(S: FloatArray) -> FloatArray:
    """The landmarks' own blocks (n, 3, 3)."""
    n = (len(S) - 6) // 3
    return S[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]


def _blocks(S: FloatArray) -> Float16Array:
    """Lower triangles of the blocks' Cholesky factors in mm and mrad, the pose's first."""
    try:
        B = _block_cholesky(S)
    except np.linalg.LinAlgError as error:
        raise ValueError("a submap's covariance must be positive definite") from error
    if not B.max(initial=0.0) / UNIT < np.finfo(np.float16).max:
        raise ValueError(f"a standard deviation of {B.max():.3g} m is too large to be sent")
    rows, columns = np.tril_indices(3)
    values = np.concatenate([B[:6, :6][np.tril_indices(6)], _small_blocks(B)[:, rows, columns].ravel()])
    return np.asarray(values / UNIT, dtype=np.float16)


def _block_matrix(blocks: Float16Array, m: int) -> FloatArray:
    B, values = np.zeros((m, m)), UNIT * blocks.astype(np.float64)
    B[:6, :6][np.tril_indices(6)] = values[:21]
    small = values[21:].reshape(-1, 6)
    rows, columns = np.tril_indices(3)
    first = 6 + 3 * np.arange(len(small))
    B[first[:, None] + rows, first[:, None] + columns] = small
    return B


def _whitened(B: FloatArray, S: FloatArray) -> FloatArray:
    """B^-1 S B^-T for a block-diagonal B."""
    inverse = np.zeros_like(B)
    inverse[:6, :6] = np.linalg.inv(B[:6, :6])
    for rows, block in zip(_slices(len(B))[1:], np.linalg.inv(_small_blocks(B)), strict=True):
        inverse[rows, rows] = block
    W = inverse @ S @ inverse.T
    return np.asarray(0.5 * (W + W.T))


def _own(U: FloatArray) -> FloatArray:
    """I less the blocks of U U', with eigenvalues of at least ``_LEAST_OWN``."""
    D = np.zeros((len(U), len(U)))
    D[:6, :6] = _floored(np.eye(6) - U[:6] @ U[:6].T)
    V = U[6:].reshape(-1, 3, U.shape[1])
    for rows, block in zip(_slices(len(U))[1:], _floored(np.eye(3) - V @ V.transpose(0, 2, 1)), strict=True):
        D[rows, rows] = block
    return D


def _floored(blocks: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(blocks)
    return np.asarray((vectors * np.maximum(values, _LEAST_OWN)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _common_directions(C: FloatArray, rank: int) -> FloatArray:
    """Factor analysis of a covariance with identity blocks: U (m, rank) by alternating between U and D."""
    from scipy.linalg import eigh  # its own half second, which receivers need not spend

    m, U = len(C), np.zeros((len(C), rank))
    D = 0.5 * np.eye(m)
    for _ in range(_ITERATIONS):
        L = _block_cholesky(D)
        values, vectors = eigh(_whitened(L, C), subset_by_index=(m - rank, m - 1))
        U = L @ (vectors * np.sqrt(np.maximum(values - 1.0, 0.0)))
        D = _own(U)
    return np.asarray(U)
