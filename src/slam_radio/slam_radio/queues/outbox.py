# SPDX-License-Identifier: Apache-2.0
"""Submaps that wait on disk until the other side has acknowledged them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from slam_radio.queues.submap_folder import SubmapFolder
from slam_radio.wire.index_ranges import IndexRanges, Key, Range, read_ranges, write_ranges


class Outbox:
    """The submaps of one agent that are still to be received; what was acknowledged is never taken again.

    A restart finds both as they were.
    """

    def __init__(self, path: Path) -> None:
        self._folder = SubmapFolder(path)
        self._ranges_file = path / "acknowledged.json"
        self.acknowledged = IndexRanges(read_ranges(self._ranges_file))
        for key in [k for k in self._folder.sizes if k in self.acknowledged]:
            self._folder.remove(key)

    @property
    def waiting(self) -> list[Key]:
        """Keys of what waits, oldest first."""
        return sorted(self._folder.sizes)

    @property
    def strangers(self) -> dict[Path, int]:
        """Files by folder that look like submaps and are of another version, or damaged."""
        return {self._folder.path: self._folder.strangers} if self._folder.strangers else {}

    def size(self, key: Key) -> int:
        """Bytes of a submap that waits."""
        return self._folder.sizes[key]

    @property
    def bytes_waiting(self) -> int:
        """Bytes of all that waits."""
        return sum(self._folder.sizes.values())

    def knows(self, key: Key) -> bool:
        """True if a submap waits or was acknowledged: a filter sends its last ones again to who comes later."""
        return key in self._folder.sizes or key in self.acknowledged

    def add(self, key: Key, light: bytes) -> None:
        """Keep a submap until it is acknowledged."""
        self._folder.add(key, light)

    def read(self, key: Key) -> tuple[int, bytes]:
        """Lowest index of its session that waits, and the bytes of a submap that waits."""
        return min(index for session, index in self._folder.sizes if session == key[0]), self._folder.read(key)

    def acknowledge(self, ranges: Iterable[Range]) -> list[Key]:
        """Remove what the other side has; returns the keys that waited until now."""
        received = IndexRanges(ranges)
        done = [key for key in self.waiting if key in received]
        if done:
            for key in done:
                self.acknowledged.add(key)
            write_ranges(self._ranges_file, self.acknowledged)
            for key in done:
                self._folder.remove(key)
        return done

    def close(self) -> None:
        """Let another process have the folder."""
        self._folder.close()
