# SPDX-License-Identifier: Apache-2.0
"""The parameters of the joined map."""

from __future__ import annotations

from dataclasses import dataclass

from sjsam_node.consistency.conditions import ConsistencyConfig
from sjsam_node.loop_closure.verification import ClosureConfig
from sjsam_node.positions.position_queue import PositionConfig
from sjsam_node.smoothing.solver import SmootherConfig
from sjsam_node.tags.known_tags import KnownTagsConfig
from slam_core.config import Config, group, parameter
from slam_core.estimation.calibration_error import CalibrationErrorConfig


@dataclass(frozen=True)
class GlobalMapConfig(Config):
    """The joined map."""

    joined_at_once: int = 12
    """Closures found when the map settles that are joined, and refused, together."""
    ties: int = parameter(8, "landmarks by which two submaps are tied together, at most", minimum=3)
    redundant_share: float = parameter(
        0.6, "share of a submap's landmarks that closures match from which on it shows nothing new", minimum=0.0
    )
    redundant_matches: int = 24
    """Least number of these landmarks."""
    smoothing: SmootherConfig = group(SmootherConfig)
    closure: ClosureConfig = group(ClosureConfig)
    consistency: ConsistencyConfig = group(ConsistencyConfig)
    calibration: CalibrationErrorConfig = group(CalibrationErrorConfig)
    tags: KnownTagsConfig = group(KnownTagsConfig)
    position: PositionConfig = group(PositionConfig)
