# SPDX-License-Identifier: Apache-2.0
"""Stereo matching of described keypoints: the normalised scalar product (Eq. 3.1) within the epipolar band.

``argmax_j  delta_i . delta_j >= alpha`` for unit-norm descriptors; a match must be the best of both sides, lie in the
band of rows around its partner, and have a disparity between the bounds that the depth range sets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import Float32Array
from stereo_frontend.keypoints import Keypoints

MAX_SIZE_RATIO = 1.25
"""Most ratio of the two keypoints' sizes."""

IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True)
class MatchingConfig(Config):
    """Limits of a stereo match."""

    min_similarity: float = parameter(
        0.7, "least scalar product of two descriptors (alpha of Eq. 3.1)", minimum=-1.0, maximum=1.0
    )
    epipolar_band: float = parameter(
        2.0, "most row difference in the rectified pair", unit="px", minimum=0.1, maximum=50.0
    )
    max_ratio: float = parameter(
        0.9,
        "most ratio of the best to the second-best descriptor distance in the band; 1 switches it off",
        minimum=0.1,
        maximum=1.0,
    )
    min_depth: float = parameter(0.3, "nearest depth looked for", unit="m", minimum=0.01)
    max_depth: float = parameter(200.0, "farthest depth looked for", unit="m", minimum=0.1)


@dataclass(frozen=True, eq=False)
class Matches:
    """Index pairs ``left[k]`` to ``right[k]`` with their ``similarity`` (scalar product), in the order of ``left``."""

    left: IndexArray
    right: IndexArray
    similarity: Float32Array

    def __len__(self) -> int:
        return len(self.left)


def disparity_bounds(config: MatchingConfig, focal_baseline: float) -> tuple[float, float]:
    """Least and greatest disparity (px) for the configured depths; ``focal_baseline`` = f b, px m."""
    return focal_baseline / config.max_depth, focal_baseline / config.min_depth


def match_stereo(left: Keypoints, right: Keypoints, config: MatchingConfig, bounds: tuple[float, float]) -> Matches:
    """Mutual best matches of a rectified pair with a disparity within ``bounds`` (px)."""
    if len(left) == 0 or len(right) == 0 or left.descriptors.shape[1] != right.descriptors.shape[1]:
        return _matches([], [], [])
    by_row = np.argsort(right.uv[:, 1], kind="stable")
    ordered = right.select(by_row)
    limits = _limits(config, bounds)
    best, value, second, best_of_right = _best_in_band(
        left.uv, np.log(left.size), left.descriptors, ordered.uv, np.log(ordered.size), ordered.descriptors, limits
    )
    keep = (value >= config.min_similarity) & (best_of_right[best] == np.arange(len(left)))
    if config.max_ratio < 1.0:
        keep &= (1.0 - value) <= config.max_ratio**2 * (1.0 - second)
    return _matches(np.flatnonzero(keep), by_row[best[keep]], value[keep])


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _best_in_band(uv, log_size, descriptors, uv_right, log_size_right, descriptors_right, limits):  # type: ignore[no-untyped-def]
    """Best and second-best scalar product of each left keypoint, and the best left one of each right keypoint.

    The right keypoints come sorted by row, so that only those in the band are multiplied: a hundredth of all pairs.
    """
    n, m = len(uv), len(uv_right)
    best = np.zeros(n, np.intp)
    value, second = np.full(n, np.float32(-2.0)), np.full(n, np.float32(-2.0))
    best_of_right, value_of_right = np.full(m, -1, np.intp), np.full(m, np.float32(-2.0))
    rows = uv_right[:, 1].copy()
    for i in range(n):
        first = np.searchsorted(rows, uv[i, 1] - limits[0])
        for j in range(first, m):
            if rows[j] > uv[i, 1] + limits[0]:
                break
            disparity = uv[i, 0] - uv_right[j, 0]
            if disparity < limits[1] or disparity > limits[2] or abs(log_size[i] - log_size_right[j]) > limits[3]:
                continue
            product = np.float32(0.0)
            for k in range(descriptors.shape[1]):
                product += descriptors[i, k] * descriptors_right[j, k]
            if product > value[i]:
                best[i], second[i], value[i] = j, value[i], product
            elif product > second[i]:
                second[i] = product
            if product > value_of_right[j]:
                best_of_right[j], value_of_right[j] = i, product
    return best, value, second, best_of_right


def is_distinct(descriptors: Float32Array, max_similarity: float) -> npt.NDArray[np.bool_]:
    """Mask (n,) of the descriptors (n, d) whose scalar product with any other one is at most ``max_similarity``."""
    similarity = descriptors @ descriptors.T
    np.fill_diagonal(similarity, -1.0)
    return np.asarray(similarity.max(axis=1, initial=-1.0) <= max_similarity)


def _limits(config: MatchingConfig, bounds: tuple[float, float]) -> FloatArray:
    """Row difference, least and greatest disparity (px), logarithm of the ratio of sizes."""
    return np.array([config.epipolar_band, bounds[0], bounds[1], np.log(MAX_SIZE_RATIO)])


def swapped_share(
    left: Keypoints, right: Keypoints, config: MatchingConfig, bounds: tuple[float, float]
) -> tuple[float, int]:
    """Share of matches with the wrong sign of disparity, near one where the images are swapped, and of how many."""
    proper = len(match_stereo(left, right, config, bounds))
    mirrored = len(match_stereo(right, left, config, bounds))
    return mirrored / max(proper + mirrored, 1), proper + mirrored


def has_consistent_neighbour(uv: Float32Array, disparity: FloatArray, neighbours: int) -> npt.NDArray[np.bool_]:
    """Mask of positions (n, 2) px that share their disparity (n,) px, within 20 % or 2 px, with a neighbour.

    On brickwork and drawers a match can slip by whole repeats and still look perfect; then it stands alone in its
    depth. NaN disparities are no neighbours and have none.
    """
    known = np.flatnonzero(np.isfinite(disparity))
    consistent = np.zeros(len(uv), bool)
    if neighbours == 0 or len(known) <= neighbours:
        consistent[known] = True
        return consistent
    u, v = np.asarray(uv[known].T, np.float64, order="C")
    consistent[known] = _nearest_is_among(u, v, np.asarray(disparity[known], np.float64), neighbours)
    return consistent


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _nearest_is_among(u, v, disparity, neighbours):  # type: ignore[no-untyped-def]
    """Mask (n,) of the positions whose nearest one of a like disparity is among so many nearest ones.

    All are compared: for some hundred positions a quarter of the time of a search tree.
    """
    n = len(u)
    out, squares = np.zeros(n, np.bool_), np.empty(n)
    for i in range(n):
        own, limit = disparity[i], max(2.0, 0.2 * disparity[i])
        for j in range(n):
            squares[j] = (u[j] - u[i]) ** 2 + (v[j] - v[i]) ** 2
        squares[i] = np.inf
        nearest, nearer = np.inf, 0
        for j in range(n):
            nearest = min(nearest, squares[j] if abs(disparity[j] - own) <= limit else np.inf)
        for j in range(n):
            nearer += squares[j] < nearest
        out[i] = nearest < np.inf and nearer < neighbours
    return out


def _matches(left: npt.ArrayLike, right: npt.ArrayLike, similarity: npt.ArrayLike) -> Matches:
    return Matches(np.asarray(left, np.intp), np.asarray(right, np.intp), np.asarray(similarity, np.float32))
