# SPDX-License-Identifier: Apache-2.0
"""A joint Gaussian of one pose and many landmarks in a few hundred bytes, never surer than the one it stands for.

    covariance = B (U U' + t D) B',    D = I - blocks of U U'

``B`` holds the Cholesky factor of each unknown's own block (6 x 6 of the pose, 3 x 3 of a landmark), so that the
whitened covariance has identity blocks. ``U`` (m, r) is what unknowns have in common, by factor analysis: a submap's
landmarks err together because the rig's poses between them do, and a few of these directions carry nearly all of it.
``D`` is what each has by itself; it follows from ``U``. Numbers are rounded first, ``t`` is chosen last: the least
factor, to 0.5 %, for which the difference to the given covariance is positive semidefinite, as its Cholesky
factorization shows. Whatever is left out or rounded can therefore only make the Gaussian less sure.

The only factorization of a matrix of full size is that one: directions are found by subspace iteration, the least
factor by the Lanczos method (Golub and Van Loan, Matrix Computations, 8.2 and 10.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, Float32Array

Int8Array = npt.NDArray[np.int8]
Float16Array = npt.NDArray[np.float16]

UNIT = 1e-3
"""Blocks are sent in mm and mrad."""
_ITERATIONS = 2
_POWERS = 3
"""Products with the covariance in each iteration of the factor analysis."""
_SPARE = 4
"""Vectors that are iterated beside those that are wanted."""
_KRYLOV = 20
"""Products with the covariance for the largest eigenvalue."""
_LEAST_STEP = 1e-5
"""A vector that is this much shorter than the matrix is long is rounding: the eigenvalue is known."""
_FACTOR_STEP = 5e-3
"""Share by which the factor is above the eigenvalue at first; then it is doubled until it is enough."""
_LEAST_OWN = 2e-3
"""Least share of an unknown's variance that is taken as its own: keeps ``D`` invertible."""
_MANTISSA = 256.0
"""Numbers of B have eight significant bits: the rest makes messages longer, and nothing surer."""
_LEAST_SHARE = 1e-4
"""Least singular value of a block of B with rows of length 1: its square, times what keeps D invertible, is well above
the rounding of a sum of all unknowns."""
_STEPS = 127.0
MOST_INFLATION = 1e6
"""Factors ``t`` from here on are not sent, nor taken: such a covariance says nothing."""
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
        B = _factors(self.blocks)
        V = B.times(U)
        return _sum(V @ V.T, B.around(_own(U)).scaled(self.inflation))

    def require_positive(self) -> None:
        """Raise ``ValueError`` if rounding may leave the covariance not positive definite.

        U U' + t D is far from singular whatever U and t are, so that this depends on the blocks of B alone.
        """
        for B in _factors(self.blocks):
            length = np.linalg.norm(B, axis=-1, keepdims=True)
            if not (length > 0.0).all() or np.linalg.svd(B / length, compute_uv=False).min(initial=1.0) < _LEAST_SHARE:
                raise ValueError("a submap for the air has a covariance that is not positive definite")

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
        If the covariance is not finite, not positive definite, or too large for the format (65 m), or if it would take
        a factor of ``MOST_INFLATION``.
    """
    if not np.isfinite(covariance).all():
        raise ValueError("a submap's covariance must be finite")
    S = covariance.copy()
    rows = np.arange(6, len(S))
    S[rows, rows] += rounding**2
    blocks = _rounded_factors(S)
    CompactGaussian(blocks, np.zeros((len(S), 0), dtype=np.int8), 1.0).require_positive()
    whiten = _factors(blocks).inverse()
    whitened = np.asarray(whiten.times(whiten.times(S).T), dtype=np.float32)
    U = _common_directions(whitened, min(rank, len(S) - 1))
    common = np.clip(np.rint(_STEPS * U), -_STEPS, _STEPS).astype(np.int8)
    inflation = _least_factor(S, blocks, common, whitened)
    up = float(np.nextafter(np.float32(inflation * _MARGIN), np.float32(np.inf)))
    return CompactGaussian(blocks, common, up)


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

    def transpose(self) -> _Blocks:
        """Transposes of the blocks."""
        return self._mapped(lambda blocks: np.swapaxes(blocks, -1, -2))

    def coarse(self) -> _Blocks:
        """The blocks in single precision."""
        return self._mapped(lambda blocks: blocks.astype(np.float32))

    def scaled(self, factor: float) -> _Blocks:
        """All blocks times a factor."""
        return self._mapped(lambda blocks: factor * blocks)

    def _mapped(self, function: Callable[[FloatArray], Any]) -> _Blocks:
        return _Blocks(function(self.pose), function(self.landmarks))

    def times(self, M: AnyArray) -> AnyArray:
        """The product with a matrix (6 + 3n, k)."""
        n, k = len(self.landmarks), M.shape[1]
        return np.concatenate([self.pose @ M[:6], (self.landmarks @ M[6:].reshape(n, 3, k)).reshape(3 * n, k)])

    def around(self, other: _Blocks) -> _Blocks:
        """A S A' for this matrix A and a symmetric one of the same blocks."""
        return _Blocks(*(_symmetric(A @ S @ np.swapaxes(A, -1, -2)) for A, S in zip(self, other, strict=True)))


def _sum(S: FloatArray, blocks: _Blocks) -> FloatArray:
    """S + blocks; S is changed."""
    rows = 6 + np.arange(3 * len(blocks.landmarks)).reshape(-1, 3)
    S[:6, :6] += blocks.pose
    S[rows[:, :, None], rows[:, None, :]] += blocks.landmarks
    return S


def _rounded_factors(S: FloatArray) -> Float16Array:
    """Lower triangles of the blocks' Cholesky factors in mm and mrad, the pose's first."""
    try:
        B = _Blocks.of(S).cholesky()
    except np.linalg.LinAlgError as error:
        raise ValueError("a submap's covariance must be positive definite") from error
    rows, columns = np.tril_indices(3)
    values = np.concatenate([B.pose[np.tril_indices(6)], B.landmarks[:, rows, columns].ravel()]) / UNIT
    mantissas, exponents = np.frexp(values)
    rounded = np.ldexp(np.rint(mantissas * _MANTISSA) / _MANTISSA, exponents)
    if not np.abs(rounded).max() <= np.finfo(np.float16).max:
        raise ValueError(f"a standard deviation of {UNIT * np.abs(values).max():.3g} m is too large to be sent")
    return np.asarray(rounded, dtype=np.float16)


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
    try:
        np.linalg.cholesky(blocks - _LEAST_OWN * np.eye(blocks.shape[-1]))
    except np.linalg.LinAlgError:
        pass
    else:
        return blocks
    values, vectors = np.linalg.eigh(blocks)
    return np.asarray((vectors * np.maximum(values, _LEAST_OWN)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _common_directions(C: Float32Array, rank: int) -> FloatArray:
    """Factor analysis of a covariance with identity blocks: U (m, rank) by alternating between U and D.

    In single precision: a direction is rounded to 127ths, and whatever it leaves is found below.
    """
    m = len(C)
    V: AnyArray = _start(m, min(rank + _SPARE, m))
    U, D = np.zeros((m, rank)), _Blocks(0.5 * np.eye(6), np.tile(0.5 * np.eye(3), ((m - 6) // 3, 1, 1)))
    for _ in range(_ITERATIONS):
        L = D.cholesky()
        left = L.inverse().coarse()
        right = left.transpose()
        for _ in range(_POWERS):
            V = left.times(C @ right.times(V))
        V = np.linalg.qr(V)[0]
        values, turns = np.linalg.eigh(V.T @ left.times(C @ right.times(V)))
        vectors = (V @ turns[:, -rank:]).astype(np.float64)
        U = L.times(vectors * np.sqrt(np.maximum(values[-rank:] - 1.0, 0.0)))
        D = _own(U)
    return np.asarray(U)


def _least_factor(S: FloatArray, blocks: Float16Array, common: Int8Array, whitened: Float32Array) -> float:
    """The least t >= 1, to 0.5 % and never less, for which the Gaussian less S is positive definite.

    ``whitened``: S between inverses of B, which gives a first t; it is tested on S itself.
    """
    U = common.astype(np.float64) / _STEPS
    left = _own(U).cholesky().inverse().coarse()
    coarse = U.astype(np.float32)
    t = max(1.0, _largest_eigenvalue(left.times(left.times(whitened - coarse @ coarse.T).T)))
    step = _FACTOR_STEP * t
    while t + step < MOST_INFLATION / _MARGIN**2:
        if _is_positive(CompactGaussian(blocks, common, t + step).covariance() - S):
            return t + step
        t, step = t + step, 2.0 * step
    raise ValueError(f"a submap's covariance would have to be sent {MOST_INFLATION:.0e} times too large")


def _largest_eigenvalue(C: Float32Array) -> float:
    """Largest eigenvalue of a symmetric matrix by the Lanczos method, from below; all vectors are kept orthogonal."""
    m = len(C)
    count = min(_KRYLOV, m)
    Q, T = np.zeros((count, m), dtype=np.float32), np.zeros((count, count))
    v = _start(m, 1)[:, 0]
    for k in range(count):
        Q[k] = v
        known, w = Q[: k + 1], C @ v
        T[: k + 1, k] = along = known @ w
        w -= along @ known
        w -= (known @ w) @ known
        length = np.linalg.norm(w)
        if length < _LEAST_STEP * np.abs(T).max():
            count = k + 1
            break
        v = w / length
    return float(np.linalg.eigvalsh(T[:count, :count], UPLO="U")[-1])


def _start(m: int, count: int) -> Float32Array:
    """Vectors (m, count), orthonormal and the same for ever, that are like no direction of a submap."""
    values = np.cos(np.arange(m * count, dtype=np.float64).reshape(m, count) ** 2)
    return np.asarray(np.linalg.qr(values)[0], dtype=np.float32)


def _symmetric(S: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (S + np.swapaxes(S, -1, -2)))


def _is_positive(S: FloatArray) -> bool:
    """True if a symmetric matrix is positive definite; it is lost."""
    from scipy.linalg.lapack import dpotrf  # its own half second, which receivers need not spend

    return bool(dpotrf(S.T, lower=0, clean=0, overwrite_a=1)[1] == 0)
