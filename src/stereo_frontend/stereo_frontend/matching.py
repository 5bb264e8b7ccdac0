"""Stereo matching of described keypoints: the normalised scalar product (Eq. 3.1) within the epipolar band.

``argmax_j  delta_i . delta_j >= alpha`` for unit-norm descriptors, as one matrix product; a match must be the best of
both sides, lie in the band of rows around its partner, and have a disparity between the bounds that the depth range
sets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.types import Float32Array
from stereo_frontend.keypoints import Keypoints

IndexArray = npt.NDArray[np.intp]
_EXCLUDED = np.float32(-2.0)


@dataclass(frozen=True)
class MatchingConfig(Config):
    """What counts as a stereo match."""

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
    max_size_ratio: float = parameter(1.5, "most ratio of the two keypoints' sizes", minimum=1.0, maximum=10.0)
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
    if len(left) == 0 or len(right) == 0:
        return _matches([], [], [])
    similarity = left.descriptors @ right.descriptors.T
    similarity[~candidate_mask(left, right, config, bounds)] = _EXCLUDED
    return mutual_best(similarity, config.min_similarity, config.max_ratio)


def candidate_mask(
    left: Keypoints, right: Keypoints, config: MatchingConfig, bounds: tuple[float, float]
) -> npt.NDArray[np.bool_]:
    """Which pairs geometry allows, shape (n_left, n_right)."""
    disparity = left.uv[:, None, 0] - right.uv[None, :, 0]
    rows = np.abs(left.uv[:, None, 1] - right.uv[None, :, 1])
    size = np.abs(np.log(left.size)[:, None] - np.log(right.size)[None, :])
    in_depth = (disparity >= bounds[0]) & (disparity <= bounds[1])
    return np.asarray(in_depth & (rows <= config.epipolar_band) & (size <= np.log(config.max_size_ratio)))


def mutual_best(similarity: Float32Array, min_similarity: float, max_ratio: float) -> Matches:
    """Pairs that are each other's best in ``similarity`` (n, m) and clearly better than the row's second best."""
    rows = np.arange(len(similarity))
    best = similarity.argmax(axis=1)
    value = similarity[rows, best]
    keep = (value >= min_similarity) & (similarity.argmax(axis=0)[best] == rows)
    if max_ratio < 1.0 and similarity.shape[1] > 1:
        second = np.partition(similarity, -2, axis=1)[:, -2]
        keep &= (1.0 - value) <= max_ratio**2 * (1.0 - second)
    return _matches(rows[keep], best[keep], value[keep])


def swapped_share(
    left: Keypoints, right: Keypoints, config: MatchingConfig, bounds: tuple[float, float]
) -> tuple[float, int]:
    """Share of matches with the wrong sign of disparity (near one: left and right images are swapped), and of how
    many.
    """
    proper = len(match_stereo(left, right, config, bounds))
    mirrored = len(match_stereo(right, left, config, bounds))
    return mirrored / max(proper + mirrored, 1), proper + mirrored


def _matches(left: npt.ArrayLike, right: npt.ArrayLike, similarity: npt.ArrayLike) -> Matches:
    return Matches(np.asarray(left, np.intp), np.asarray(right, np.intp), np.asarray(similarity, np.float32))
