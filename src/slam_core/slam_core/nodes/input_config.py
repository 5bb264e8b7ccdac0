# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of every node, their pairing and queues: the parameters ``input.*``."""

from __future__ import annotations

from dataclasses import dataclass

from slam_core.config import Config, parameter
from slam_core.nodes.job_queue import POLICIES
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S

MAX_WAITING_FRAMES = 1
"""Frames of an input that may wait with policy newest."""
OVERDUE_S = 1.0
"""With policy newest: longest wait of a frame for another sensor, s."""


@dataclass(frozen=True)
class InputConfig(Config):
    """Subscriptions, pairing and queues of a node; parameters ``input.*`` of every node."""

    reliability: str = parameter(
        "match",
        "reliability of subscriptions; match: what the publisher offers",
        choices=("match", "reliable", "best_effort"),
    )
    policy: str = parameter(
        "newest",
        "frames that come faster than they are processed; newest: only the newest wait, the others are left out and"
        " counted; all: every frame is processed, however late",
        choices=POLICIES,
    )
    depth: int = parameter(200, "messages kept per topic until received, and until paired", minimum=1)
    pairing_tolerance_s: float = parameter(
        PAIRING_TOLERANCE_S, "largest difference of stamps that belong together", unit="s", minimum=0.0
    )
