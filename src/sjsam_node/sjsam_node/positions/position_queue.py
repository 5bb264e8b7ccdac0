# SPDX-License-Identifier: Apache-2.0
"""Positions that have been measured, by agent, until the submap comes inside which they were."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.nodes.stamp_guard import StampGuard
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
ODD = "positions_with_an_odd_stamp"


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
class _Stream:
    """Readings of an agent that wait, and the stamp of the newest one that was taken (ns)."""

    guard: StampGuard[PositionReading] = field(default_factory=StampGuard)
    waiting: list[PositionReading] = field(default_factory=list)
    newest_ns: int | None = None


@dataclass
class PositionQueue:
    """Keeps what comes, and gives each submap its own.

    counts: of what was rejected, by reason.
    """

    interval_ns: int
    counters: Counters = field(default_factory=Counters)
    _streams: dict[str, _Stream] = field(default_factory=lambda: defaultdict(_Stream))

    def add(self, agent: str, reading: PositionReading) -> None:
        """Take a reading of an agent; an unusable one, and one with an odd stamp, are counted.

        After a jump back in time all begins anew.
        """
        if not is_usable(reading.covariance):
            self.counters.add(UNUSABLE)
            return
        if not np.abs(reading.position).max() <= FARTHEST:
            self.counters.add(FAR)
            return
        stream = self._streams[agent]
        decision = stream.guard.add("position", reading.stamp_ns, reading)
        if decision.rejected:
            self.counters.add(ODD, len(decision.rejected))
        if decision.new_session:
            self._count_late(len(stream.waiting))
            stream.waiting, stream.newest_ns = [], None
        for stamp_ns, released in decision.released:
            if stream.newest_ns is None or stamp_ns >= stream.newest_ns + self.interval_ns:
                stream.waiting.append(released)
                stream.newest_ns = stamp_ns

    def take(self, submap: Submap) -> tuple[PositionReading, ...]:
        """The readings inside a submap, its end included; older ones are let go."""
        waiting = self._streams[submap.agent].waiting
        before = [r for r in waiting if r.stamp_ns <= submap.end_stamp_ns]
        inside = tuple(r for r in before if r.stamp_ns > submap.start_stamp_ns)
        self._count_late(len(before) - len(inside))
        del waiting[: len(before)]
        return inside

    def clear(self) -> None:
        """Forget what waits."""
        self._streams.clear()

    def _count_late(self, amount: int) -> None:
        if amount:
            self.counters.add(LATE, amount)


def is_usable(covariance: FloatArray) -> bool:
    """True if a covariance (3, 3) is finite, symmetric, and neither nothing nor huge along any axis."""
    P = covariance
    if not np.isfinite(P).all() or np.abs(P - P.T).max() > 1e-6 * np.abs(P).max():
        return False
    values = np.linalg.eigvalsh(P)
    return bool(values[0] >= SMALLEST_SIGMA**2 and values[-1] <= LARGEST_SIGMA**2)
