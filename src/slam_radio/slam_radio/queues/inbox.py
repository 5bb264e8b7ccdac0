# SPDX-License-Identifier: Apache-2.0
"""Submaps that have come over the link: kept on disk before they are acknowledged, passed on in order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from slam_core.types import Submap
from slam_radio.packing.light_submap import unpack
from slam_radio.packing.submap_details import key_of_details, with_details
from slam_radio.queues.submap_folder import SubmapFolder
from slam_radio.wire.index_ranges import IndexRanges, Key, Range, read_ranges, write_ranges
from slam_radio.wire.radio_messages import MOST_RANGES, unpack_submap


class Inbox:
    """Submaps that one agent has sent.

    A submap behind a gap waits until its agent has filled it or has nothing to fill it.

    A restart finds what has come, and passes all of it on again.
    """

    def __init__(self, agent: str, path: Path) -> None:
        self.agent = agent
        self._folder = SubmapFolder(path)
        self.received = IndexRanges((session, index, index + 1) for session, index in self._folder.sizes)
        self._held = set(self._folder.sizes)
        self._floors_file = path / "floors.json"
        self._floors = {session: end for session, _, end in read_ranges(self._floors_file)}
        self._details = SubmapFolder(path / "details", key_of_details)
        self._wanted_file = path / "wanted.json"
        asked = IndexRanges(read_ranges(self._wanted_file))
        self.wanted = {key for key in self._folder.sizes if key in asked and key not in self._details.sizes}
        self._untold_file = path / "untold.json"
        self._untold = IndexRanges(read_ranges(self._untold_file))
        self._next: dict[int, int] = {}
        for session, index in sorted(self._held, reverse=True):
            self._next[session] = index
        self.repeated = 0
        self._newest: Key | None = None
        self._unpacked: dict[Key, Submap] = {}

    def take(self, key: Key, data: bytes) -> list[Submap]:
        """Keep the submap of a message; returns what may be passed on now.

        Raises
        ------
        ValueError
            If the message is damaged, or of another agent or submap than its key says.
        OSError
            If it cannot be written; it is then not acknowledged.
        """
        floor, light = unpack_submap(data)
        submap = unpack(light)
        if (submap.agent, submap.session, submap.index) != (self.agent, *key) or floor > key[1]:
            raise ValueError(f"submap {submap.agent} {submap.session}/{submap.index} came as {self.agent} {key}")
        if key in self.received:
            self.repeated += 1
        else:
            self._folder.add(key, light)
            self.received.add(key)
            self._held.add(key)
            self._unpacked[key] = submap
        self._newest = key
        if floor > self._next.setdefault(key[0], 0) and floor > self._floors.get(key[0], 0):
            self._floors[key[0]] = floor
            write_ranges(self._floors_file, [(s, 0, end) for s, end in sorted(self._floors.items())])
        return self.release()

    def release(self) -> list[Submap]:
        """Submaps that may be passed on, in order: what is held and needs to wait for none before it."""
        released = []
        for key in sorted(self._held):
            if key[1] <= max(self._next[key[0]], self._floors.get(key[0], 0)):
                self._held.remove(key)
                self._next[key[0]] = max(self._next[key[0]], key[1] + 1)
                released.append(self._submap(key))
        return released

    def _submap(self, key: Key) -> Submap:
        """A submap that has come, with its details if they have."""
        light = self._unpacked.pop(key, None)
        if key in self._details.sizes:
            return with_details(self._folder.read(key), self._details.read(key))
        return light or unpack(self._folder.read(key))

    def ask(self, keys: Iterable[Key] | None = None) -> int:
        """Want the details of some submaps that have come, or of all; returns of how many more than before.

        What the agent said it cannot tell is asked for again only with all others.
        """
        asked = set(self._folder.sizes if keys is None else keys) & set(self._folder.sizes)
        if keys is None:
            self._set_untold(IndexRanges())
        new = {key for key in asked - set(self._details.sizes) - self.wanted if key not in self._untold}
        if new:
            self._set_wanted(self.wanted | new)
        return len(new)

    def give_up(self, ranges: Iterable[Range]) -> int:
        """Want some details no more, which the agent cannot tell; returns of how many submaps."""
        gone = IndexRanges(ranges)
        keys = {key for key in self.wanted if key in gone}
        if keys:
            untold = IndexRanges(self._untold)
            for key in keys:
                untold.add(key)
            self._set_untold(untold)
            self._set_wanted(self.wanted - keys)
        return len(keys)

    def _set_untold(self, untold: IndexRanges) -> None:
        write_ranges(self._untold_file, untold)
        self._untold = untold

    def take_details(self, key: Key, data: bytes) -> list[Submap]:
        """Keep the details of a submap; returns the submap with them, unless it waits or was returned with them before.

        Raises
        ------
        ValueError
            If they are damaged, or of another submap, or of one that is not here.
        OSError
            If they cannot be written; they are then still wanted.
        """
        if key not in self._folder.sizes:
            raise ValueError(f"details of submap {self.agent} {key}, which is not here")
        submap = with_details(self._folder.read(key), data)
        if key not in self._details.sizes:
            self._details.add(key, data)
        elif key not in self.wanted:  # else the disk was full when this was to be noted
            self.repeated += 1
            return []
        self._set_wanted(self.wanted - {key})
        return [] if key in self._held else [submap]

    def _set_wanted(self, wanted: set[Key]) -> None:
        write_ranges(self._wanted_file, _ranges(wanted))
        self.wanted = wanted

    def lacking(self) -> list[Range]:
        """Ranges of the submaps whose details are wanted."""
        return _ranges(self.wanted)

    def kept(self) -> Iterator[tuple[Key, bytes]]:
        """Keys and bytes of the submaps that lie on disk, oldest first."""
        for key in sorted(self._folder.sizes):
            yield key, self._folder.read(key)

    @property
    def held(self) -> int:
        """Submaps that wait for one before them."""
        return len(self._held)

    def acknowledgement(self) -> list[Range]:
        """Ranges of what has come, that of the newest message first, then those of the newest sessions."""
        newest = self.received.around(self._newest) if self._newest else None
        others = [entry for entry in reversed(list(self.received)) if entry != newest]
        return [*([newest] if newest else []), *others][:MOST_RANGES]

    def forget(self) -> None:
        """Remove what has come from disk; it stays acknowledged while this process lives."""
        for key in list(self._folder.sizes):
            self._folder.remove(key)
        for key in list(self._details.sizes):
            self._details.remove(key)
        self._set_wanted(set())
        self._set_untold(IndexRanges())
        self._held.clear()
        self._unpacked.clear()

    @property
    def strangers(self) -> dict[Path, int]:
        """Files by folder that look like messages and are of another version, or damaged."""
        return {folder.path: folder.strangers for folder in (self._folder, self._details) if folder.strangers}

    def close(self) -> None:
        """Let another process have the folder."""
        self._folder.close()
        self._details.close()


def _ranges(keys: Iterable[Key]) -> list[Range]:
    return list(IndexRanges((session, index, index + 1) for session, index in keys))
