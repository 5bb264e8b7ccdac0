# SPDX-License-Identifier: Apache-2.0
"""Closed-form and robust alignment of corresponding point sets (Umeyama 1991; Fischler and Bolles 1981)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray, make_transform

_MOST_REFITS = 10


def umeyama(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Rigid ``T_target_source`` minimising ``sum w |target - T source|^2`` (Umeyama 1991, without scale).

    Parameters
    ----------
    source, target
        Corresponding points, shape (..., n, 3), n >= 3; leading dimensions are solved in one call.
    weights
        Shape (..., n), non-negative; None weighs all alike.

    Returns
    -------
    array, shape (..., 4, 4)
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    w = np.ones(source.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum(axis=-1, keepdims=True)
    source_mean = np.einsum("...n,...ni->...i", w, source)
    target_mean = np.einsum("...n,...ni->...i", w, target)
    H = np.einsum("...n,...ni,...nj->...ij", w, target - target_mean[..., None, :], source - source_mean[..., None, :])
    U, _, Vt = np.linalg.svd(H)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    R = U @ Vt
    return make_transform(R, target_mean - np.einsum("...ij,...j->...i", R, source_mean))


@dataclass(frozen=True, eq=False)
class AlignmentResult:
    """Result of :func:`ransac_rigid_transform`: ``T`` = T_target_source, mask of the inliers (n,), success."""

    T: FloatArray
    inliers: npt.NDArray[np.bool_]
    success: bool


def ransac_rigid_transform(
    source: FloatArray,
    target: FloatArray,
    threshold: FloatArray | float,
    rng: np.random.Generator,
    *,
    hypotheses: int = 256,
    min_inliers: int = 6,
) -> AlignmentResult:
    """Rigid transform between corresponding points of which many may be wrong.

    All hypotheses are drawn and solved at once, the best is refitted to its inliers until these no longer change.

    Parameters
    ----------
    source, target
        Shape (n, 3), m.
    threshold
        Largest distance of an inlier, m; a scalar or one per correspondence (n,).
    rng
        Source of the samples: the same generator state gives the same result.
    hypotheses
        Number of samples of three points.
    min_inliers
        Fewer inliers than this are no success.
    """
    n = len(source)
    if n < max(3, min_inliers):
        return _failed(n)
    threshold_sq = np.square(np.broadcast_to(np.asarray(threshold, dtype=np.float64), (n,)))
    samples = np.argpartition(rng.random((hypotheses, n)), 2, axis=1)[:, :3]
    T = umeyama(source[samples], target[samples])
    residual = np.einsum("hij,nj->hni", T[:, :3, :3], source) + T[:, None, :3, 3] - target
    distance_sq = np.einsum("hni,hni->hn", residual, residual)
    # Truncated cost (MSAC, Torr and Zisserman 2000) tells apart hypotheses with equal numbers of inliers.
    cost = np.minimum(distance_sq / threshold_sq, 1.0).sum(axis=1)
    best = int(np.argmin(cost))
    return _refitted(source, target, threshold_sq, T[best], distance_sq[best] < threshold_sq, min_inliers)


def _refitted(
    source: FloatArray,
    target: FloatArray,
    threshold_sq: FloatArray,
    estimate: FloatArray,
    inliers: npt.NDArray[np.bool_],
    min_inliers: int,
) -> AlignmentResult:
    """The transform fitted to its inliers until these stay the same."""
    for _ in range(_MOST_REFITS):
        if inliers.sum() < max(3, min_inliers):
            return _failed(len(source))
        estimate = umeyama(source[inliers], target[inliers], 1.0 / threshold_sq[inliers])
        error = source @ estimate[:3, :3].T + estimate[:3, 3] - target
        updated = np.einsum("ni,ni->n", error, error) < threshold_sq
        if np.array_equal(updated, inliers):
            break
        inliers = updated
    return AlignmentResult(estimate, inliers, bool(inliers.sum() >= min_inliers))


def _failed(n: int) -> AlignmentResult:
    return AlignmentResult(np.eye(4), np.zeros(n, dtype=bool), False)
