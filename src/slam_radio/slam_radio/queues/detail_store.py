# SPDX-License-Identifier: Apache-2.0
"""Details that an agent can tell of its submaps, packed and sent when a post wants them."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from slam_core.types import Submap
from slam_radio.packing.submap_details import key_of_details, pack_details
from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.queues.in_flight import InFlight
from slam_radio.queues.submap_folder import SubmapFolder
from slam_radio.queues.whole_submaps import WholeSubmaps
from slam_radio.wire.index_ranges import IndexRanges, Key, Range
from slam_radio.wire.radio_messages import MOST_RANGES, pack_none


class DetailStore:
    """Details of an agent's submaps, and those of them that the post wants.

    Whole submaps lie on disk, up to ``most_bytes``; beyond that the oldest are packed, a thousandth of their size. The
    post says again and again what it lacks: what it wants no more it has. What the agent cannot tell it says once each
    time. A restart of the agent has nothing to remember but the files.
    """

    def __init__(
        self, path: Path, bytes_per_second: float = 20000.0, resend_after_s: float = 5.0, most_bytes: float = 5e8
    ) -> None:
        self.folder = SubmapFolder(path, key_of_details)
        self.whole = WholeSubmaps(path / "whole")
        self.sent = 0
        self.damaged = 0
        self._most_bytes = most_bytes
        self._flight = InFlight(bytes_per_second, resend_after_s)
        self._wanted: list[Key] = []
        self._none = IndexRanges()

    @property
    def strangers(self) -> dict[Path, int]:
        """Files by folder that look like details and are of another version, or damaged."""
        counts = {self.folder.path: self.folder.strangers, self.whole.path: len(self.whole.strangers)}
        return {path: count for path, count in counts.items() if count}

    def keep(self, key: Key, submap: Submap, message: bytes) -> None:
        """Keep what the message of a submap leaves out; OSError if it cannot be written."""
        self.whole.add(key, submap, message)
        with suppress(OSError):  # a full disk: at the next one
            while self.whole.sizes and self.whole.total > self._most_bytes:
                self._pack(min(self.whole.sizes))

    def want(self, ranges: Iterable[Range]) -> None:
        """The post lacks these, and, if they are not too many for a message, no others."""
        listed = list(ranges)
        lacking, known = IndexRanges(listed), sorted({*self.folder.sizes, *self.whole.sizes})
        for key in self._wanted:
            if key not in lacking and len(listed) < MOST_RANGES:
                self._flight.landed(key)
        self._wanted = [key for key in known if key in lacking]
        self._none = lacking.without(self._wanted)

    def hurry(self, now_s: float) -> None:
        """The post is back: what was under way may have been lost."""
        self._flight.hurry(now_s)

    def none(self) -> bytes | None:
        """Message of what the post wants and this agent cannot tell; None if there is no such thing."""
        ranges = list(self._none)
        return pack_none(ranges) if ranges else None

    def none_is_sent(self) -> None:
        """That message goes out: the post will ask again if it is lost."""
        self._none = IndexRanges()

    def ready(self, now_s: float) -> Key | None:
        """Key of the details that go out next, packed; None while there are none or enough are under way."""
        for key in [k for k in self._wanted if self._flight.is_due(k, now_s)]:
            if not self._flight.fits(self.folder.sizes.get(key, 0) + OVERHEAD, now_s):
                return None
            try:
                if key in self.folder.sizes or self._pack(key):
                    return key if self._flight.fits(self.size(key), now_s) else None
            except OSError:  # a full disk: later
                self._flight.sent(key, 0, now_s)
                continue
            self._give_up(key)
        return None

    def size(self, key: Key) -> int:
        """Bytes on the wire of details that are packed."""
        return self.folder.sizes[key] + OVERHEAD

    def take(self, key: Key, now_s: float) -> bytes | None:
        """The bytes of details that go out now; None if their file is gone."""
        try:
            data = self.folder.read(key)
        except (OSError, ValueError):
            self._give_up(key)
            return None
        self._flight.sent(key, self.size(key), now_s)
        self.sent += 1
        return data

    def _give_up(self, key: Key) -> None:
        """The post is to know that these do not come."""
        self._wanted.remove(key)
        self.folder.sizes.pop(key, None)
        self._none.add(key)

    def _pack(self, key: Key) -> bool:
        """Pack the details of a whole submap in its place; False if there are none.

        A file that is damaged stays where it is and is not looked at again.
        """
        try:
            submap, light, message = self.whole.read(key)
        except ValueError:
            self.whole.set_aside(key)
            self.damaged += 1
            return False
        try:
            details = pack_details(submap, light, message)
            if details is not None:
                self.folder.add(key, details)
        except ValueError:  # a number is too large to be sent
            self.damaged += 1
            details = None
        self.whole.remove(key)
        return details is not None
