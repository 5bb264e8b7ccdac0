# SPDX-License-Identifier: Apache-2.0
"""The order in which each agent made its submaps, and which of them have not arrived.

The transport is reliable and keeps the order, but a filter keeps a limited number of submaps for a joiner that comes
late or was cut off. A submap that is joined before the one it follows would hang in the map by recognised places alone;
those that come after a gap are therefore held until it is filled, or until nobody can fill it any more.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, TypeVar

Chain = tuple[str, int]
"""Agent and session."""

T = TypeVar("T")

_PATIENCE_S = 5.0
"""A submap that was asked for again has so long to come."""


class SubmapOrder(Generic[T]):
    """Lets through what comes in order, and holds the rest.

    Parameters
    ----------
    known
        (agent, session, index) of submaps that have arrived in an earlier life.
    """

    def __init__(self, known: Iterable[tuple[str, int, int]] = ()) -> None:
        self._next: dict[Chain, int] = {}
        self._held: dict[Chain, dict[int, T]] = {}
        self._asked_at_s: float | None = None
        for agent, session, index in known:
            self._next[agent, session] = max(self._next.get((agent, session), 0), index + 1)

    def add(self, key: tuple[str, int, int], item: T) -> list[T]:
        """Take the submap of (agent, session, index); returns what may be joined now, in order."""
        chain, index = key[:2], key[2]
        if index < self._next.setdefault(chain, 0):
            return [item]  # sent again
        self._held.setdefault(chain, {})[index] = item
        return self._released(chain)

    def missing(self) -> dict[Chain, range]:
        """The indices that others wait for, by agent and session."""
        return {chain: range(self._next[chain], min(held)) for chain, held in self._held.items()}

    def should_ask(self, now_s: float) -> bool:
        """True once after something is found missing: ask for it. Times are those of any steady clock, s."""
        if not self._held:
            self._asked_at_s = None
        elif self._asked_at_s is None:
            self._asked_at_s = now_s
            return True
        return False

    def overdue(self, now_s: float) -> dict[Chain, range]:
        """The indices that are missing although they were asked for some time ago."""
        is_over = self._asked_at_s is not None and now_s > self._asked_at_s + _PATIENCE_S
        return self.missing() if is_over else {}

    def give_up(self) -> list[T]:
        """Wait no longer for what is missing now; returns what may be joined without, in order."""
        released, self._asked_at_s = [], None
        for chain, indices in self.missing().items():
            self._next[chain] = indices.stop
            released += self._released(chain)
        return released

    def _released(self, chain: Chain) -> list[T]:
        held, released = self._held[chain], []
        while self._next[chain] in held:
            released.append(held.pop(self._next[chain]))
            self._next[chain] += 1
        if not held:
            del self._held[chain]
        return released


def gap_text(agent: str, indices: range) -> str:
    """Text for a user whose submaps did not arrive."""
    return (
        f"submaps {indices.start} to {indices.stop - 1} of agent '{agent}' did not arrive: what follows becomes part "
        "of the map when a place is recognised. Filters keep their last submaps only: start sjsam before them, and "
        "look at the link between the hosts"
    )
