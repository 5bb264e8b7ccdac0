# SPDX-License-Identifier: Apache-2.0
"""The gate at the filter's door: features that cannot be measurements stay outside."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import MeasurementConfig
from ekf_slam_node.models import Frame, frame_from_features
from slam_core.camera import MIN_DEPTH
from slam_core.types import Features

_FARTHEST_M, _LARGEST_PX, _SMALLEST_SIGMA = 1e5, 1e6, 1e-6
"""Limits of what can be a feature: depth m, pixel, standard deviation px or m."""


def usable_features(features: Features, limits: MeasurementConfig) -> np.ndarray:
    """Mask (n,) of the features that are finite, within sensible limits and of a depth known well enough."""
    sigma = np.column_stack([features.sigma_uv, features.sigma_depth])
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(features.uv).all(axis=1) & np.isfinite(features.depth) & np.isfinite(sigma).all(axis=1)
        usable &= (features.depth > MIN_DEPTH) & (features.depth < _FARTHEST_M) & (sigma > _SMALLEST_SIGMA).all(axis=1)
        usable &= np.abs(features.uv).max(axis=1, initial=0.0) < _LARGEST_PX
        usable &= features.sigma_depth < limits.max_relative_depth_sigma * features.depth
        usable &= np.isfinite(features.descriptors).all(axis=1)
    return usable


def frame_of_strongest(features: Features, usable: np.ndarray, limits: MeasurementConfig) -> Frame:
    """The strongest of the usable features as a frame, in their own order."""
    index = np.flatnonzero(usable)
    strongest = np.argsort(-features.response[index], kind="stable")[: limits.max_features]
    return frame_from_features(features, np.sort(index[strongest]), limits.min_sigma_px, limits.min_sigma_depth)
