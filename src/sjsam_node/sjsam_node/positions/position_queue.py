# SPDX-License-Identifier: Apache-2.0
"""Positions that have been measured, by agent, until the submap comes inside which they were."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import Counters, PositionReading, Submap

LARGEST_SIGMA = 100.0
"""Standard deviation beyond which a position does not say where in a building one is (m)."""
SMALLEST_SIGMA = 1e-3
"""Standard deviation below which no receiver is believed (m)."""
FARTHEST = 1e5
"""Distance from the frame's origin beyond which its axes are not those of one place on earth (m)."""
UNUSABLE = "positions_without_a_usable_covariance"
FAR = "positions_too_far_from_their_origin"
LATE = "positions_in_no_submap"


@dataclass(frozen=True)
class PositionConfig(Config):
    """Positions of an antenna on the rig in a fixed frame of its own, of UWB or GNSS."""

    use: str = parameter("auto", "positions on the topic position", choices=("auto", "off"))
    lever_arm: tuple[float, ...] = parameter((0.0, 0.0, 0.0), "place of the antenna in the base frame", unit="m")
    interval: float = parameter(
        1.0, "positions closer in time share what they err by: of these one counts", unit="s", minimum=0.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.lever_arm) != 3:
            raise ValueError(f"lever_arm has three numbers (m), got {list(self.lever_arm)}")


@dataclass
class PositionQueue:
    """Keeps what comes, and gives each submap its own.

    counts: of what was rejected, by reason.
    """

    interval_ns: int
    counters: Counters = field(default_factory=Counters)
    _waiting: dict[str, list[PositionReading]] = field(default_factory=lambda: defaultdict(list))

    def add(self, agent: str, reading: PositionReading) -> None:
        """Take a reading of an agent; an unusable one is counted. After a jump back in time all begins anew."""
        if not is_usable(reading.covariance):
            self.counters.add(UNUSABLE)
            return
        if not np.abs(reading.position).max() <= FARTHEST:
            self.counters.add(FAR)
            return
        waiting = self._waiting[agent]
        if waiting and reading.stamp_ns < waiting[-1].stamp_ns:
            self.counters.add(LATE, len(waiting))
            waiting.clear()
        if not waiting or reading.stamp_ns >= waiting[-1].stamp_ns + self.interval_ns:
            waiting.append(reading)

    def take(self, submap: Submap) -> tuple[PositionReading, ...]:
        """The readings inside a submap, its end included; older ones are let go."""
        waiting = self._waiting[submap.agent]
        before = [r for r in waiting if r.stamp_ns <= submap.end_stamp_ns]
        inside = tuple(r for r in before if r.stamp_ns > submap.start_stamp_ns)
        if len(before) > len(inside):
            self.counters.add(LATE, len(before) - len(inside))
        del waiting[: len(before)]
        return inside

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()


def is_usable(covariance: FloatArray) -> bool:
    """True if a covariance (3, 3) is finite, symmetric, and neither nothing nor huge along any axis."""
    P = covariance
    if not np.isfinite(P).all() or np.abs(P - P.T).max() > 1e-6 * np.abs(P).max():
        return False
    values = np.linalg.eigvalsh(P)
    return bool(values[0] >= SMALLEST_SIGMA**2 and values[-1] <= LARGEST_SIGMA**2)
