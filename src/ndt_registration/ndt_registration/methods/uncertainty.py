# SPDX-License-Identifier: Apache-2.0
"""Covariance of a registration: directions in which it determines the pose, and those it leaves free.

Covariance from the scatter of the blocks' gradients, and directions left free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ndt_registration.clouds.block_table import Int32Array
from slam_core.config import Config
from slam_core.geometry import FloatArray, skew

_PROBE = 0.03
"""Distance by which the pose is moved to see whether it is determined, over the scale."""
_FREE_SIGMA = 1.0
"""Largest standard deviation given to a free direction, over the scale."""
_SIGMA_FLOOR = 1e-5
"""Least standard deviation of any direction, over the scale."""


@dataclass(frozen=True)
class UncertaintyConfig(Config):
    """Covariance and degeneracy of a registration."""

    least_loss: float = 0.015
    """Share of its fit that a determined pose loses by that."""
    loss_noise: float = 1.0
    """Loss that chance makes up for: a free direction is known to the probe times this over its loss."""


class Uncertainty(NamedTuple):
    """Covariance (6, 6) of the pose error.

    Unit directions (k, 6) that are not determined, rotations about the matched points.
    """

    covariance: FloatArray
    free: FloatArray


class Curvature(NamedTuple):
    """Second derivatives of the cost at the optimum (6, 6).

    Exact, its semidefinite majorant, and the part of either that errors of the cells' normals alone make.
    """

    hessian: FloatArray
    majorant: FloatArray
    spurious_hessian: FloatArray
    spurious_majorant: FloatArray


class Extent(NamedTuple):
    """Extent of the matched points: centroid (3,) and root mean square distance from it, m."""

    centre: FloatArray
    radius: float


def sandwich(
    curvature: Curvature,
    scatter: FloatArray,
    extent: Extent,
    loss: Callable[[FloatArray], float],
    scale: float,
    fixed: npt.NDArray[np.bool_],
    config: UncertaintyConfig,
) -> Uncertainty:
    """Covariance ``A^-1 C A^-1`` of an M-estimate: curvature ``A``, covariance ``C`` of its gradient (White 1982).

    A direction is free where the score hardly falls when the pose is moved along it by much more than the noise; no
    curvature shows that alone, because the small errors of many normals make some. What they make in the mean is taken
    off the curvature, else the directions that little determines would seem far better known than they are. How far
    the pose may be off along a free direction follows from the loss: chance makes up for so much of it.

    Rotations are taken about the centre of what was matched, and angles times its radius: only there can the curvatures
    of translations and rotations be compared (Zhang and Singh 2016 on degeneracy).

    scatter: covariance (6, 6) of the cost's gradient, see :func:`gradient_scatter`. loss: share of the score that is
    lost when the pose is moved by a vector (6,) or back. scale: m, free directions get ``_FREE_SIGMA`` times this.
    fixed: (6,) components of the pose error that were constrained; their variance is that of the floor.
    """
    to_pose = _about(extent)
    H, M, F, spurious, C = (to_pose.T @ A @ to_pose for A in (*curvature, scatter))
    for A in (H, M, F, spurious, C):
        A[fixed], A[:, fixed] = 0.0, 0.0
    vectors = np.linalg.eigh(M)[1]
    constrained = np.abs(vectors[fixed]).sum(axis=0) > 0.5
    free, sigma = np.zeros(6, dtype=bool), np.zeros(6)
    for k in np.flatnonzero(~constrained):
        v = vectors[:, k]
        step = _PROBE * scale * (to_pose @ v)
        lost = loss(step)
        free[k] = _is_free(v @ H @ v, v @ M @ v, v @ spurious @ v, lost, config)
        sigma[k] = scale * min(_FREE_SIGMA, _PROBE * config.loss_noise / max(lost, 1e-9))
        if not free[k] and lost > _WELL_DETERMINED * config.least_loss:
            break
    covariance = (_SIGMA_FLOOR * scale) ** 2 * np.eye(6)
    known = vectors[:, ~free & ~constrained]
    if known.shape[1]:
        inverse = _inverse(known.T @ (H - F) @ known, known.T @ M @ known)
        covariance += known @ inverse @ (known.T @ C @ known) @ inverse @ known.T
    covariance += (vectors[:, free] * sigma[free] ** 2) @ vectors[:, free].T
    covariance = to_pose @ covariance @ to_pose.T
    return Uncertainty(0.5 * (covariance + covariance.T), vectors[:, free].T)


def _about(extent: Extent) -> FloatArray:
    """Pose error (6,) from translation and scaled rotation about the centre of what was matched, as a matrix (6, 6)."""
    to_pose = np.eye(6)
    to_pose[:3, 3:] = skew(extent.centre) / extent.radius
    to_pose[3:, 3:] /= extent.radius
    return to_pose


def _is_free(hessian: float, majorant: float, spurious: float, lost: float, config: UncertaintyConfig) -> bool:
    """True if a direction of these curvatures, along which so much of the score is lost, is not determined."""
    least = config.least_loss * (_SPURIOUS_FACTOR if hessian < spurious else 1.0)
    return bool(majorant <= spurious or lost < least)


def clear_loss(config: UncertaintyConfig) -> float:
    """Loss among a few hundred points that shows a direction to be determined, whatever the others say."""
    return _SPURIOUS_FACTOR * config.least_loss + _LOSS_OF_FEW


def gradient_scatter(gradients: FloatArray, places: Int32Array, width: int, density_ratio: float) -> FloatArray:
    """Covariance (6, 6) of the cost's gradient from those (b, 6) of small blocks at integer places (b, 3).

    They vanish in sum at the optimum; their scatter contains the noise of the source's points, discretisation and
    wrong matches alike. Blocks near each other share errors: pixels of one edge do, and a real depth camera is off by
    the same over a whole wall or table. So the gradients are summed over cubes of ``width`` blocks first (the
    cluster-robust covariance of Liang and Zeger 1986), over smaller ones where that would leave too few. The target's
    points err as much as the source's and move the optimum as far, but alike for all blocks that meet one plane, so
    that little of it shows in the scatter: it is counted as the source's, times ``density_ratio``, the source's number
    of points over the target's.

    What is the same in every pair of scans from two places, because the two views show rims and edges from other sides,
    is seen only as far as cubes disagree about it (``covariance.py`` among the benchmarks).
    """
    each = _scatter_of(gradients)
    while width > 1:
        sums = _sums_of_cubes(gradients, places // width)
        if len(sums) >= _FEWEST_CUBES:
            return (1.0 + density_ratio) * _at_least(each, _scatter_of(sums))
        width //= 2
    return (1.0 + density_ratio) * each


def _sums_of_cubes(gradients: FloatArray, cubes: Int32Array) -> FloatArray:
    """Sums (c, 6) of the gradients (b, 6) of each cube at integer places (b, 3), in the order of the places.

    These span less than 2^21 along each axis.
    """
    x, y, z = (cubes - cubes.min(axis=0, initial=0)).astype(np.int64).T
    _, number = np.unique((x << 42) | (y << 21) | z, return_inverse=True)
    return np.stack([np.bincount(number, column) for column in gradients.T], axis=1)


def _scatter_of(gradients: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the sum of gradients (b, 6) that err independently."""
    return np.asarray(len(gradients) / max(len(gradients) - 6, 1) * (gradients.T @ gradients))


def _at_least(least: FloatArray, covariance: FloatArray) -> FloatArray:
    """The covariance, in no direction less than another one: that of few cubes is too small by chance in some."""
    root = np.linalg.cholesky(least + _SUMS_ROUNDING * (np.trace(least) + 1e-300) * np.eye(6))
    whitened = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    back = root @ vectors
    return np.asarray(back * np.maximum(values, 1.0) @ back.T)


_FEWEST_CUBES = 30
"""Fewest cubes whose scatter says something of six directions."""


def _inverse(hessian: FloatArray, majorant: FloatArray) -> FloatArray:
    """Inverse of the exact curvature, bounded where that says nearly nothing.

    In directions where it is (nearly) none or less, that of a share of the majorant.
    """
    root = np.linalg.cholesky(majorant + _SUMS_ROUNDING * np.trace(majorant) * np.eye(len(majorant)))
    whitened = np.linalg.solve(root, np.linalg.solve(root, hessian).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    back = np.linalg.solve(root.T, vectors)
    return np.asarray(back / np.maximum(values, _LEAST_RELATIVE_CURVATURE) @ back.T)


_SUMS_ROUNDING = 1e-6
"""Error of a curvature over its trace: what is summed in one group of points is float32."""
_LEAST_RELATIVE_CURVATURE = 0.05
_WELL_DETERMINED = 10.0
"""So many times the least loss: directions of more curvature than one that loses this need not be tried."""
_LOSS_OF_FEW = 0.08
"""Nearly four standard deviations of the loss among 500 points."""
_SPURIOUS_FACTOR = 2.0
"""So many times the loss is asked for where the curvature is no more than what errors of the normals make."""


def unknown(scale: float) -> FloatArray:
    """Covariance (6, 6) of a pose of which nothing is known: every direction free."""
    sigma = _FREE_SIGMA * max(scale, 1.0)
    return np.diag(np.r_[np.full(3, sigma), np.full(3, _FREE_SIGMA)] ** 2)


def direction_names(free: FloatArray) -> tuple[str, ...]:
    """Readable names of free directions (k, 6), such as ``translation along (0.00, 1.00, 0.00)``."""
    names = []
    for direction in free:
        translation, rotation = np.linalg.norm(direction[:3]), np.linalg.norm(direction[3:])
        kind, axis = (
            ("translation along", direction[:3]) if translation >= rotation else ("rotation about", direction[3:])
        )
        axis = axis / np.linalg.norm(axis)
        axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] > 0 else -1.0) + 0.0
        names.append(f"{kind} ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})")
    return tuple(names)
