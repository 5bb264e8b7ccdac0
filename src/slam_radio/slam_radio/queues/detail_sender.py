# SPDX-License-Identifier: Apache-2.0
"""Details that one other side wants of an agent's submaps: which go out next, and which there are not."""

from __future__ import annotations

from collections.abc import Iterable

from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.in_flight import InFlight
from slam_radio.wire.index_ranges import IndexRanges, Key, Range
from slam_radio.wire.radio_messages import MOST_RANGES, pack_none


class DetailSender:
    """The wants of a post, or of another agent, and what is under way to it.

    It says again and again what it lacks: what it wants no more it has. What the agent cannot tell it says once each
    time. A restart of the agent has nothing to remember.
    """

    def __init__(self, store: DetailStore, bytes_per_second: float = 20000.0, resend_after_s: float = 5.0) -> None:
        self.store, self.sent = store, 0
        self._flight = InFlight(bytes_per_second, resend_after_s)
        self._wanted: list[Key] = []
        self._none = IndexRanges()

    def want(self, ranges: Iterable[Range]) -> None:
        """The other side lacks these, and, if they are not too many for a message, no others."""
        listed = list(ranges)
        lacking = IndexRanges(listed)
        for key in self._wanted:
            if key not in lacking and len(listed) < MOST_RANGES:
                self._flight.landed(key)
        self._wanted = [key for key in self.store.keys if key in lacking]
        self._none = lacking.without(self._wanted)

    def hurry(self, now_s: float) -> None:
        """The other side is back: what was under way may have been lost."""
        self._flight.hurry(now_s)

    def none(self) -> bytes | None:
        """Message of what is wanted and this agent cannot tell; None if there is no such thing."""
        ranges = list(self._none)
        return pack_none(ranges) if ranges else None

    def none_is_sent(self) -> None:
        """That message goes out: the other side will ask again if it is lost."""
        self._none = IndexRanges()

    def ready(self, now_s: float) -> Key | None:
        """Key of the details that go out next, packed; None while there are none or enough are under way."""
        for key in [k for k in self._wanted if self._flight.is_due(k, now_s)]:
            if not self._flight.fits(self.size(key), now_s):
                return None
            try:
                if self.store.pack(key):
                    return key if self._flight.fits(self.size(key), now_s) else None
            except OSError:  # a full disk: later
                self._flight.sent(key, 0, now_s)
                continue
            self._give_up(key)
        return None

    def size(self, key: Key) -> int:
        """Bytes on the wire of details; of those that are not packed, the headers."""
        return self.store.size(key) + OVERHEAD

    def take(self, key: Key, now_s: float) -> bytes | None:
        """The bytes of details that go out now; None if their file is gone."""
        size = self.size(key)
        if (data := self.store.read(key)) is None:
            self._give_up(key)
            return None
        self._flight.sent(key, size, now_s)
        self.sent += 1
        return data

    def _give_up(self, key: Key) -> None:
        """The other side is to know that these do not come."""
        self._wanted.remove(key)
        self._none.add(key)
