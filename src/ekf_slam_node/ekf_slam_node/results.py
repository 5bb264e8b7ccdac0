# SPDX-License-Identifier: Apache-2.0
"""Result of the filter for each frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import PoseEstimate, Submap


class TrackingState(Enum):
    """OK; DEGRADED: working, but something is wrong with the input; LOST: the frame could not be linked to the map."""

    OK = "OK"
    DEGRADED = "DEGRADED"
    LOST = "LOST"


@dataclass(frozen=True, eq=False)
class LandmarkView:
    """Landmarks of the open submap in the odom frame.

    Ids (n,), positions (n, 3), covariances (n, 3, 3), sightings (n,).
    """

    ids: np.ndarray
    positions: FloatArray
    covariances: FloatArray
    sightings: np.ndarray


@dataclass(frozen=True, eq=False)
class EkfResult:
    """One frame's outcome.

    pose: T_odom_rig. twist: (6,) linear m/s and angular rad/s in the rig frame. twist_covariance: (6, 6). submaps:
    those finished by this frame. nis, nis_dof: of the update. landmark_ids: (k,) ids of the landmarks measured;
    feature_index: (k,) the features they are.
    """

    stamp_ns: int
    pose: PoseEstimate
    twist: FloatArray
    twist_covariance: FloatArray
    state: TrackingState
    reason: str
    submaps: tuple[Submap, ...]
    nis: float = 0.0
    nis_dof: int = 0
    landmark_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    feature_index: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
