# SPDX-License-Identifier: Apache-2.0
"""The thesis's plain ICP (10.2): nearest neighbours within one rejection limit, point to point, no more."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from slam_core.geometry import FloatArray, transform_points
from slam_core.rigid_alignment import umeyama

MAX_ITERATIONS = 100
TOLERANCE = 1e-5


def plain_icp(source: FloatArray, target: FloatArray, rejection_limit: float) -> FloatArray:
    """T_target_source (4, 4) of points (n, 3) and (m, 3), started from identity; ``rejection_limit`` m."""
    tree, T = cKDTree(target), np.eye(4)
    for _ in range(MAX_ITERATIONS):
        moved = transform_points(T, source)
        distance, nearest = tree.query(moved, distance_upper_bound=rejection_limit)
        paired = np.isfinite(distance)
        if paired.sum() < 3:
            return T
        step = umeyama(moved[paired], target[nearest[paired]])
        T = step @ T
        if np.abs(step - np.eye(4)).max() < TOLERANCE:
            return T
    return T
