# SPDX-License-Identifier: Apache-2.0
"""The gate at the filter's door: features that cannot be measurements stay outside."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.models import Frame, frame_from_features
from slam_core.camera import MIN_DEPTH
from slam_core.types import Features

_MAX_RELATIVE_DEPTH_SIGMA = 0.3
"""Features of a larger sigma of depth / depth are not used; a limit that cuts through many favours those whose noise
makes them look near and biases the motion.
"""
_MIN_SIGMA_PX = 0.05
"""Floor of the pixel noise, px."""
_MIN_SIGMA_DEPTH = 1e-4
"""Floor of the depth noise, m."""

_FARTHEST_M, _LARGEST_PX, _SMALLEST_SIGMA = 1e5, 1e6, 1e-6
"""Limits of what can be a feature: depth m, pixel, standard deviation px or m."""


def usable_features(features: Features) -> np.ndarray:
    """Mask (n,) of the features that are finite, within sensible limits and of a depth known well enough."""
    sigma = np.column_stack([features.sigma_uv, features.sigma_depth])
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(features.uv).all(axis=1) & np.isfinite(features.depth) & np.isfinite(sigma).all(axis=1)
        usable &= (features.depth > MIN_DEPTH) & (features.depth < _FARTHEST_M) & (sigma > _SMALLEST_SIGMA).all(axis=1)
        usable &= np.abs(features.uv).max(axis=1, initial=0.0) < _LARGEST_PX
        usable &= features.sigma_depth < _MAX_RELATIVE_DEPTH_SIGMA * features.depth
        usable &= np.isfinite(features.descriptors).all(axis=1)
    return usable


def frame_of_strongest(features: Features, usable: np.ndarray, most: int) -> Frame:
    """At ``most`` so many of the usable features as a frame: the strongest, in their own order."""
    index = np.flatnonzero(usable)
    strongest = np.argsort(-features.response[index], kind="stable")[:most]
    return frame_from_features(features, np.sort(index[strongest]), _MIN_SIGMA_PX, _MIN_SIGMA_DEPTH)
