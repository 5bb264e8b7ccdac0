# SPDX-License-Identifier: Apache-2.0
"""Faults of a submap by itself, whatever map it is for."""

from __future__ import annotations

import numpy as np

from sjsam_node.graph.map_graph import BUILDING, POSITIONS
from slam_core.geometry import is_rigid_transform
from slam_core.linear_algebra import blas
from slam_core.messages.poses import FARTHEST_M
from slam_core.types import Submap

SMALLEST_VARIANCE = 1e-15
"""Of a landmark (m2) or an end pose (m2, rad2); no camera is that sure of anything."""


def fault_of(submap: Submap) -> str:
    """Reason for which no map can take a submap; empty if there is none."""
    if submap.agent == BUILDING or submap.agent.startswith(POSITIONS):
        return f"no agent may be called {BUILDING}, or begin with {POSITIONS}"
    if not (np.all(np.isfinite(submap.covariance)) and np.all(np.isfinite(submap.landmarks))):
        return "not finite"
    if np.abs(submap.landmarks).max(initial=0.0) > FARTHEST_M:
        return f"landmarks beyond {FARTHEST_M:g} m"
    if np.diag(submap.covariance).min() < SMALLEST_VARIANCE:
        return f"variances below {SMALLEST_VARIANCE:g}, less than any sensor's"
    if not is_rigid_transform(submap.end_pose):
        return "end pose is not a rigid transform"
    if not blas.cholesky(np.array(submap.covariance, np.float64, order="F")):
        return "covariance is not positive definite"
    return ""
