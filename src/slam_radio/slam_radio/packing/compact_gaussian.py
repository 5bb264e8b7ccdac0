# SPDX-License-Identifier: Apache-2.0
"""A joint Gaussian of one pose and many landmarks in a few hundred bytes, never surer than the one it stands for.

    covariance = B (s U U' + t D) B',    D = I - blocks of U U'

``B`` holds a factor of each unknown's own block: the Cholesky factor of the pose (6 x 6), and of a landmark (3 x 3) the
one in a frame whose third axis points at it from the middle of the submap, where it is nearly diagonal. The whitened
covariance has identity blocks. ``U`` (m, r) is what unknowns have in common, by factor analysis: a submap's landmarks
err together because the rig's poses between them do, and a few of these directions carry nearly all of it. ``D`` is
what each has by itself; it follows from ``U``. Numbers are rounded first. ``s`` is 5 % more than 1: what rounding does
to the common directions lies mostly along them. ``t`` is chosen last: the least factor, to 0.5 %, for which the
difference to the given covariance is positive semidefinite, as its Cholesky factorization shows. Whatever is left out
or rounded can therefore only make the Gaussian less sure.

The only factorization of a matrix of full size is that one: directions are found by subspace iteration, the least
factor by the Lanczos method (Golub and Van Loan, Matrix Computations, 8.2 and 10.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, Float32Array
from slam_radio.packing import packing_kernels
from slam_radio.packing.block_diagonal import BlockDiagonal

IntArray = npt.NDArray[np.int64]
Product = Callable[[AnyArray], AnyArray]
"""The products of a matrix (m, m) with vectors (m, k)."""

UNIT = 1e-3
"""Factors are sent in mm and mrad."""
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
_OCTAVE = 45
"""Steps of a standard deviation from one value to its double: 1.5 % each."""
_RATIO = 64
"""Steps of the numbers beside the diagonal, over that of their row."""
_MOST_OCTAVES = 24
_LEAST_SHARE = 1e-4
"""Least singular value of a block of B with rows of length 1: its square, times what keeps D invertible, is well above
the rounding of a sum of all unknowns."""
_STEPS = 64.0
"""Steps of U from 0 to 1."""
_COMMON = 1.05
"""The factor ``s``."""
MOST_INFLATION = 1e6
"""Factors ``t`` from here on are not sent, nor taken: such a covariance says nothing."""
_MARGIN = 1.0 + 1e-6
"""The factor ``t`` is enlarged by the rounding of the sum that it is checked with."""


@dataclass(frozen=True, eq=False)
class CompactGaussian:
    """A covariance as it is sent.

    Attributes
    ----------
    pose
        Lower triangle of the pose's factor in mm and mrad, (21,) float16.
    factors
        Of each landmark (n, 6): logarithms of the diagonal of its factor, in 45ths of an octave above 1 mm, and the
        three numbers beside it, in 64ths of their rows' diagonals.
    rays
        Of each landmark, from the middle of the submap, (n, 3); of any length.
    common
        U in 64ths, (6 + 3n, r).
    inflation
        The factor t.
    """

    pose: npt.NDArray[np.float16]
    factors: IntArray
    rays: FloatArray
    common: IntArray
    inflation: float

    def covariance(self) -> FloatArray:
        """The covariance (6 + 3n, 6 + 3n), positive definite."""
        U = self.common.astype(np.float64) / _STEPS
        B = self.blocks()
        V = np.sqrt(_COMMON) * B.times(U)
        return _sum(V @ V.T, B.around(_own(U)).scaled(self.inflation))

    def blocks(self) -> BlockDiagonal:
        """The blocks of B."""
        return BlockDiagonal(_pose_factor(self.pose), _ray_frames(self.rays) @ _factors(self.factors))

    def require_positive(self) -> None:
        """Raise ``ValueError`` if rounding may leave the covariance not positive definite.

        s U U' + t D is far from singular whatever U and t are, so that this depends on the blocks of B alone.
        """
        if not np.isfinite(self.pose).all():
            raise ValueError("a submap for the air holds numbers that are not finite")
        if (np.abs(self.factors[:, :3]) // _OCTAVE).max(initial=0) >= _MOST_OCTAVES:
            raise ValueError("a submap for the air has a covariance that cannot be")
        for L in (_pose_factor(self.pose), _factors(self.factors)):
            length = np.linalg.norm(L, axis=-1, keepdims=True)
            if not (length > 0.0).all() or _is_nearly_singular(L / length):
                raise ValueError("a submap for the air has a covariance that is not positive definite")

    def end_covariance(self) -> FloatArray:
        """The pose's own covariance (6, 6)."""
        U = self.common[:6] / _STEPS
        L = _pose_factor(self.pose)
        return np.asarray(L @ (_COMMON * U @ U.T + self.inflation * _floored(np.eye(6) - U @ U.T)) @ L.T)

    def followed_by(self, factors: IntArray, rays: FloatArray, common: IntArray, inflation: float) -> CompactGaussian:
        """The Gaussian with more landmarks, and another factor t."""
        return CompactGaussian(
            self.pose, np.concatenate([self.factors, factors]), np.concatenate([self.rays, rays]),
            np.concatenate([self.common, common]), inflation,
        )  # fmt: skip


def compact_gaussian(covariance: FloatArray, rays: FloatArray, rank: int, rounding: float = 0.0) -> CompactGaussian:
    """The Gaussian of a pose and n landmarks with ``rank`` common directions.

    Parameters
    ----------
    covariance
        Shape (6 + 3n, 6 + 3n), positive definite, m and rad.
    rays
        Of each landmark as the other side will know it, (n, 3).
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
    S = _with_rounding(covariance, rounding)
    rounded = CompactGaussian(*_rounded_factors(S, rays), rays, np.zeros((len(S), 0), dtype=np.int64), 1.0)
    rounded.require_positive()
    B = rounded.blocks()
    whitened = _whitened(S, B)
    U = _common_directions(whitened, min(rank, len(S) - 1))
    return _with_least_factor(S, replace(rounded, common=_rounded(U)), B, whitened)


def extended(
    gaussian: CompactGaussian, covariance: FloatArray, rays: FloatArray, rounding: float = 0.0
) -> CompactGaussian:
    """A Gaussian with more landmarks behind its own, by the common directions that it has.

    Parameters
    ----------
    gaussian
        Of the pose and the first landmarks.
    covariance
        Of the pose and all landmarks.
    rays, rounding
        As above, of the landmarks that are new.

    Raises
    ------
    ValueError
        As :func:`compact_gaussian`.
    """
    known = len(gaussian.common)
    S = _with_rounding(covariance, rounding)
    _, factors = _rounded_factors(S, np.concatenate([gaussian.rays, rays]))
    none = np.zeros((len(S) - known, gaussian.common.shape[1]), dtype=np.int64)
    rounded = gaussian.followed_by(factors[len(gaussian.factors) :], rays, none, 1.0)
    rounded.require_positive()
    B = rounded.blocks()
    whitened = _whitened(S, B)
    U = gaussian.common / _STEPS
    weighted = _own(U).mapped(np.linalg.inv).times(U)
    more = np.linalg.lstsq(U.T @ weighted, weighted.T @ whitened[:known, known:], rcond=None)[0].T
    return _with_least_factor(
        S, replace(rounded, common=np.concatenate([gaussian.common, _rounded(more)])), B, whitened
    )


def _is_nearly_singular(triangles: FloatArray) -> bool:
    """True if one of some triangular matrices (..., m, m) with rows of length 1 has too small a singular value.

    That is at least the determinant over m^((m - 1) / 2), since none is larger than m^0.5: mostly enough to know.
    """
    m = triangles.shape[-1]
    determinants = np.abs(np.prod(np.diagonal(triangles, axis1=-2, axis2=-1), axis=-1))
    if determinants.min(initial=1.0) > 2.0 * _LEAST_SHARE * m ** (0.5 * (m - 1)):
        return False
    return bool(np.linalg.svd(triangles, compute_uv=False).min(initial=1.0) < _LEAST_SHARE)


def _sum(S: FloatArray, blocks: BlockDiagonal) -> FloatArray:
    """S + blocks; S is changed."""
    rows = 6 + np.arange(3 * len(blocks.landmarks)).reshape(-1, 3)
    S[:6, :6] += blocks.pose
    S[rows[:, :, None], rows[:, None, :]] += blocks.landmarks
    return S


def _with_rounding(covariance: FloatArray, rounding: float) -> FloatArray:
    """A copy of a covariance in which the landmarks' variances have the square of an error more."""
    if not np.isfinite(covariance).all():
        raise ValueError("a submap's covariance must be finite")
    S = covariance.copy()
    rows = np.arange(6, len(S))
    S[rows, rows] += rounding**2
    return S


def _rounded_factors(S: FloatArray, rays: FloatArray) -> tuple[npt.NDArray[np.float16], IntArray]:
    """The pose's factor (21,) and the landmarks' (n, 6), as they are sent."""
    R = _ray_frames(rays)
    try:
        pose, landmarks = BlockDiagonal.of(S)
        L = np.linalg.cholesky(pose), np.linalg.cholesky(np.swapaxes(R, 1, 2) @ landmarks @ R)
    except np.linalg.LinAlgError as error:
        raise ValueError("a submap's covariance must be positive definite") from error
    values = L[0][np.tril_indices(6)] / UNIT
    if not max(np.abs(values).max(), np.abs(L[1]).max(initial=0.0) / UNIT) <= np.finfo(np.float16).max:
        raise ValueError(f"a standard deviation of {np.abs(L[1]).max(initial=0.0):.3g} m is too large to be sent")
    sigmas = L[1][:, np.arange(3), np.arange(3)]
    ratios = L[1][:, *_BESIDE] / sigmas[:, _BESIDE[0]]
    logarithms = np.rint(_OCTAVE * np.log2(sigmas / UNIT))
    return values.astype(np.float16), np.concatenate([logarithms, np.rint(_RATIO * ratios)], axis=1).astype(np.int64)


def _pose_factor(values: npt.NDArray[np.float16]) -> FloatArray:
    """The pose's factor (6, 6), m and rad."""
    L = np.zeros((6, 6))
    L[np.tril_indices(6)] = UNIT * values.astype(np.float64)
    return L


_BESIDE = np.tril_indices(3, -1)


def _factors(codes: IntArray) -> FloatArray:
    """Landmarks' factors (n, 3, 3), m, in the frames of their rays."""
    L = np.zeros((len(codes), 3, 3))
    sigmas = UNIT * np.exp2(codes[:, :3] / _OCTAVE)
    L[:, np.arange(3), np.arange(3)] = sigmas
    L[:, *_BESIDE] = codes[:, 3:] / _RATIO * sigmas[:, _BESIDE[0]]
    return L


def _ray_frames(rays: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) whose third columns are along rays (n, 3), or along z where there is none."""
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    z = np.where(length > 0.0, rays / np.maximum(length, np.finfo(np.float64).tiny), [0.0, 0.0, 1.0])
    other = np.where(np.abs(z[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    x = np.cross(other, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _whitened(S: FloatArray, B: BlockDiagonal) -> Float32Array:
    """B^-1 S B'^-1 in single precision."""
    out = np.empty(S.shape, dtype=np.float32)
    packing_kernels.between(*B.inverse(), S, out)
    return out


def _scaled(L: BlockDiagonal, C: Product) -> Product:
    """Products of vectors (m, k) with L^-1 C L'^-1, in single precision."""
    inverse = L.inverse().coarse()
    transposed = inverse.mapped(lambda blocks: np.ascontiguousarray(np.swapaxes(blocks, -1, -2)))
    return lambda V: inverse.times(C(transposed.times(V)))


def _rounded(U: AnyArray) -> IntArray:
    return np.clip(np.rint(_STEPS * U), -_STEPS, _STEPS).astype(np.int64)


def _own(U: FloatArray) -> BlockDiagonal:
    """I less the blocks of U U', with eigenvalues of at least ``_LEAST_OWN``."""
    V = U[6:].reshape(-1, 3, U.shape[1])
    return BlockDiagonal(_floored(np.eye(6) - U[:6] @ U[:6].T), _floored(np.eye(3) - V @ V.transpose(0, 2, 1)))


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

    In single precision: a direction is rounded to 64ths, and whatever it leaves is found below.
    """
    m = len(C)
    V: AnyArray = _start(m, min(rank + _SPARE, m))
    U, D = np.zeros((m, rank)), BlockDiagonal(0.5 * np.eye(6), np.tile(0.5 * np.eye(3), ((m - 6) // 3, 1, 1)))
    for _ in range(_ITERATIONS):
        L = D.cholesky()
        scaled = _scaled(L, lambda X: C @ X)
        for _ in range(_POWERS):
            V = scaled(V)
        V = np.linalg.qr(V)[0]
        values, turns = np.linalg.eigh(V.T @ scaled(V))
        vectors = (V @ turns[:, -rank:]).astype(np.float64)
        U = L.times(vectors * np.sqrt(np.maximum(values[-rank:] - 1.0, 0.0)))
        D = _own(U)
    return np.asarray(U)


def _with_least_factor(
    S: FloatArray, rounded: CompactGaussian, B: BlockDiagonal, whitened: Float32Array
) -> CompactGaussian:
    """The Gaussian with the least t >= 1, to 0.5 % and never less, for which it less S is positive definite.

    ``B``: the blocks of the Gaussian; ``whitened``: S between their inverses, which gives a first t. It is tested on S.
    """
    U = rounded.common / _STEPS
    own, coarse = _own(U), (np.sqrt(_COMMON) * U).astype(np.float32)
    left = _scaled(own.cholesky(), lambda X: whitened @ X - coarse @ (coarse.T @ X))
    t = max(1.0, _largest_eigenvalue(left, len(S)))
    step = _FACTOR_STEP * t
    V, own = np.sqrt(_COMMON) * B.times(U), B.around(own)
    while t + step < MOST_INFLATION / _MARGIN**2:
        gap = V @ V.T
        packing_kernels.with_blocks(*own.scaled(t + step), S, gap)
        if _is_positive(gap):
            up = float(np.nextafter(np.float32((t + step) * _MARGIN), np.float32(np.inf)))
            return replace(rounded, inflation=up)
        t, step = t + step, 2.0 * step
    raise ValueError(f"a submap's covariance would have to be sent {MOST_INFLATION:.0e} times too large")


def _largest_eigenvalue(C: Product, m: int) -> float:
    """Largest eigenvalue of a symmetric matrix by the Lanczos method, from below; all vectors are kept orthogonal."""
    count = min(_KRYLOV, m)
    Q, T = np.zeros((count, m), dtype=np.float32), np.zeros((count, count))
    v = _start(m, 1)[:, 0]
    for k in range(count):
        Q[k] = v
        known, w = Q[: k + 1], C(v[:, None])[:, 0]
        T[: k + 1, k] = along = known @ w
        w -= along @ known
        w -= (known @ w) @ known
        length = np.linalg.norm(w)
        if length < _LEAST_STEP * np.abs(T).max():
            count = k + 1
            break
        v = w / length
    return float(np.linalg.eigvalsh(T[:count, :count], UPLO="U")[-1])


@lru_cache(maxsize=8)
def _start(m: int, count: int) -> Float32Array:
    """Vectors (m, count), orthonormal and the same for ever, that are like no direction of a submap."""
    values = np.cos(np.arange(m * count, dtype=np.float64).reshape(m, count) ** 2)
    return np.asarray(np.linalg.qr(values)[0], dtype=np.float32)


def _is_positive(S: FloatArray) -> bool:
    """True if a symmetric matrix, of which the lower triangle is read, is positive definite; it is lost."""
    from scipy.linalg.lapack import dpotrf  # its own half second, which receivers need not spend

    return bool(dpotrf(S.T, lower=0, clean=0, overwrite_a=1)[1] == 0)
