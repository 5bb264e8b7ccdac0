"""Gives each item of one stream the item of another that is nearest in time, without waiting for ever.

Stereo pairs and ToF images seldom share a stamp. The nodes and the offline pipeline pair them here, so both see the same pairs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

A = TypeVar("A")
B = TypeVar("B")


class NearestPartner(Generic[A, B]):
    """Hands on every main item, in order, with its nearest partner or None.

    A main item waits until a partner of its own time or later arrives, or until the main stream is ``max_wait_ns`` ahead.

    Parameters
    ----------
    on_pair
        Called with (stamp_ns, main, partner or None).
    tolerance_ns
        Largest difference of the stamps of a pair.
    max_wait_ns
        How far the main stream may run ahead of the partners.
    """

    def __init__(
        self, on_pair: Callable[[int, A, B | None], None], *, tolerance_ns: int = 50_000_000, max_wait_ns: int = 500_000_000
    ) -> None:
        if tolerance_ns < 0 or max_wait_ns < 0:
            raise ValueError(f"pairing needs tolerance and wait >= 0 ns, got {tolerance_ns} and {max_wait_ns} ns")
        self._on_pair = on_pair
        self._tolerance_ns = tolerance_ns
        self._max_wait_ns = max_wait_ns
        self._main: deque[tuple[int, A]] = deque()
        self._partners: deque[tuple[int, B]] = deque()
        self.alone = 0
        """Main items handed on without a partner."""

    def add_main(self, stamp_ns: int, item: A) -> None:
        """Take an item of the main stream."""
        self._main.append((stamp_ns, item))
        self._release()

    def add_partner(self, stamp_ns: int, item: B) -> None:
        """Take an item of the other stream."""
        self._partners.append((stamp_ns, item))
        self._release()

    def flush(self) -> None:
        """Hand on whatever waits: nothing more will come."""
        while self._main:
            self._emit()

    def clear(self) -> None:
        """Forget everything that waits."""
        self._main.clear()
        self._partners.clear()

    def _release(self) -> None:
        while self._main:
            stamp = self._main[0][0]
            decided = bool(self._partners) and self._partners[-1][0] >= stamp
            if not decided and self._main[-1][0] - stamp <= self._max_wait_ns:
                return
            self._emit()

    def _emit(self) -> None:
        stamp, item = self._main.popleft()
        best = min(self._partners, key=lambda p: abs(p[0] - stamp), default=None)
        partner = best[1] if best is not None and abs(best[0] - stamp) <= self._tolerance_ns else None
        self.alone += partner is None
        while len(self._partners) > 1 and self._partners[1][0] <= stamp:
            self._partners.popleft()
        self._on_pair(stamp, item, partner)
