# SPDX-License-Identifier: Apache-2.0
"""The landmarks of a submap that are sent: by a rule that chooses the same ones of every submap that sees them.

A closure needs landmarks that both submaps have sent. Of 250 landmarks 96 chosen at random by each side leave 15 % in
common, and so does a choice by certainty or spread, which depend on the view. Here the descriptor alone decides: those
landmarks go out whose descriptors lie farthest along one fixed direction. Two sightings of a landmark agree on it (the
ranks' correlation is 0.93 to 0.97), so that both sides choose nearly the same ones without knowing of each other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.tags import is_tag_corner
from slam_core.types import Float32Array, Submap
from slam_radio.packing.descriptor_code import basis
from slam_radio.packing.packing_kernels import crowded

_COLUMN = 1
"""Of the basis: the direction in which SURF-128 descriptors differ most from each other; all share the first one."""
_APART = 0.03
"""Tangent of the angle, from the submap's middle pose, below which a landmark adds nothing to one beside it."""


def choose_landmarks(submap: Submap, most: int) -> npt.NDArray[np.int64]:
    """Rows of at most ``most`` landmarks, in the order of their ids.

    In the order of :func:`rank_values`; one so near another one chosen that a closure would count them once comes only
    after all that stand apart. Corners of fiducial tags stay behind.
    """
    order = np.argsort(-rank_values(submap.descriptors), kind="stable")
    order = order[~is_tag_corner(submap.landmark_ids[order])]
    if len(order) > most:
        crowded = _is_crowded(submap.landmarks[order])
        order = np.concatenate([order[~crowded], order[crowded]])[:most]
    return np.asarray(order[np.argsort(submap.landmark_ids[order])], dtype=np.int64)


def rank_values(descriptors: Float32Array) -> FloatArray:
    """Coordinate (n,) of descriptors along a direction that is part of the format, the same for all submaps."""
    dimension = descriptors.shape[1]
    if dimension == len(basis()):
        return np.asarray(descriptors @ basis()[:, _COLUMN], dtype=np.float64)
    return np.asarray(descriptors @ np.cos(np.arange(dimension, dtype=np.float64) ** 2))


def _is_crowded(points: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (n,) of points beside an earlier one that is not crowded itself."""
    return np.asarray(crowded(points, _APART * np.maximum(np.linalg.norm(points, axis=1), 1.0)))
