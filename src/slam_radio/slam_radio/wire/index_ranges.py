# SPDX-License-Identifier: Apache-2.0
"""Sets of submaps, (session, index), as the few ranges that they are."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

from slam_core.storage.files import atomic_text, read_json

Key = tuple[int, int]
"""Session and index of a submap of one agent."""

Range = tuple[int, int, int]
"""Session, first index and the index behind the last."""


class IndexRanges:
    """A set of submaps; ``ranges`` lists it, in order."""

    def __init__(self, ranges: Iterable[Range] = ()) -> None:
        self._ends: dict[int, dict[int, int]] = {}
        for entry in ranges:
            self.add_range(entry)

    def __contains__(self, key: Key) -> bool:
        return any(first <= key[1] < end for first, end in self._ends.get(key[0], {}).items())

    def __iter__(self) -> Iterator[Range]:
        for session in sorted(self._ends):
            yield from ((session, first, end) for first, end in sorted(self._ends[session].items()))

    def add(self, key: Key) -> None:
        """Add one submap."""
        self.add_range((key[0], key[1], key[1] + 1))

    def add_range(self, entry: Range) -> None:
        """Add a range; those that it touches become one with it."""
        session, first, end = entry
        if not 0 <= first < end:
            raise ValueError(f"a range of submaps must not be empty, got {first} to {end}")
        ends = self._ends.setdefault(session, {})
        for other in [f for f, e in ends.items() if f <= end and first <= e]:
            first, end = min(first, other), max(end, ends.pop(other))
        ends[first] = end

    def without(self, keys: Iterable[Key]) -> IndexRanges:
        """The set less some submaps."""
        out = IndexRanges()
        gone: dict[int, list[int]] = {}
        for session, index in sorted(keys):
            gone.setdefault(session, []).append(index)
        for session, first, end in self:
            for index in (i for i in gone.get(session, ()) if first <= i < end):
                if first < index:
                    out.add_range((session, first, index))
                first = index + 1
            if first < end:
                out.add_range((session, first, end))
        return out

    def around(self, key: Key) -> Range | None:
        """The range that holds a submap, or None."""
        for first, end in self._ends.get(key[0], {}).items():
            if first <= key[1] < end:
                return key[0], first, end
        return None


def write_ranges(path: Path, ranges: Iterable[Range]) -> None:
    """Write ranges to a file of their own, whole or not at all."""
    atomic_text(path, json.dumps(list(ranges)))


def read_ranges(path: Path) -> list[Range]:
    """The ranges of a file, none where there is no file; ValueError if it is not one of ours."""
    if not path.exists():
        return []
    value = read_json(path)
    try:
        return [(int(session), int(first), int(end)) for session, first, end in value]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} does not list ranges of submaps ({error}): move it away") from None
