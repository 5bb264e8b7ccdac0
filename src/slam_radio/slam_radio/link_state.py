# SPDX-License-Identifier: Apache-2.0
"""Health of a link: when the other side was last heard, and if it carries what comes in."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from slam_core.health import State

_RECENT_S = 60.0
_PATIENCE_S = 30.0
"""A submap may wait so long on a link that is up before the link is said to carry too little."""


@dataclass(frozen=True)
class LinkState:
    """State of a link at some time, for ``/diagnostics``."""

    state: State
    reason: str
    backlog_bytes: int
    backlog_s: float


class Hearing:
    """Last message of another side. Times are those of any steady clock, s."""

    def __init__(self, silent_after_s: float) -> None:
        self._silent_after_s = silent_after_s
        self._last_s: float | None = None
        self._up_since_s = 0.0
        self.known = False

    def heard(self, now_s: float) -> None:
        """Something has come."""
        if not self.is_up(now_s):
            self._up_since_s = now_s
        self._last_s, self.known = now_s, True

    def is_up(self, now_s: float) -> bool:
        """True if something has come lately."""
        return self._last_s is not None and now_s - self._last_s <= self._silent_after_s

    def up_for_s(self, now_s: float) -> float:
        """Time since the last silence, 0 in silence."""
        return now_s - self._up_since_s if self.is_up(now_s) else 0.0

    def heard_s_ago(self, now_s: float) -> float | None:
        """Time since the last message; None where there was none."""
        return None if self._last_s is None else now_s - self._last_s

    def text(self, who: str, now_s: float) -> str:
        """Complaint of silence, or ""."""
        if self._last_s is None:
            return f"{who} has not been heard yet"
        return "" if self.is_up(now_s) else f"{who} silent for {now_s - self._last_s:.0f} s"


class Carriage:
    """Bytes that came in and bytes that were carried in the last minute."""

    def __init__(self) -> None:
        self._in: deque[tuple[float, int]] = deque()
        self._out: deque[tuple[float, int]] = deque()

    def came(self, size: int, now_s: float) -> None:
        """So many bytes are to be carried."""
        self._in.append((now_s, size))

    def carried(self, size: int, now_s: float) -> None:
        """So many bytes have arrived."""
        self._out.append((now_s, size))

    def rates(self, now_s: float) -> tuple[float, float]:
        """Bytes a second that came in and that were carried."""
        return _rate(self._in, now_s), _rate(self._out, now_s)

    def is_too_much(self, waits_s: float, up_for_s: float, now_s: float) -> bool:
        """True if submaps wait long on a link that is up, and more comes in than it carries."""
        came, carried = self.rates(now_s)
        return min(waits_s, up_for_s) > _PATIENCE_S and came > carried


def _rate(events: deque[tuple[float, int]], now_s: float) -> float:
    while events and events[0][0] < now_s - _RECENT_S:
        events.popleft()
    return sum(size for _, size in events) / _RECENT_S
