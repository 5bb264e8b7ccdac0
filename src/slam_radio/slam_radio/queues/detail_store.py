# SPDX-License-Identifier: Apache-2.0
"""Details that an agent can tell of its submaps, on its disk, packed when somebody wants them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from slam_core.types import Submap
from slam_radio.packing.submap_details import key_of_details, pack_details
from slam_radio.queues.submap_folder import SubmapFolder
from slam_radio.queues.whole_submaps import WholeSubmaps
from slam_radio.wire.index_ranges import Key


class DetailStore:
    """Details of an agent's submaps, for all who may ask for them.

    Whole submaps lie on disk, up to ``most_bytes``; beyond that the oldest are packed, a thousandth of their size. A
    restart of the agent has nothing to remember but the files.
    """

    def __init__(self, path: Path, most_bytes: float = 5e8) -> None:
        self.folder = SubmapFolder(path, key_of_details)
        self.whole = WholeSubmaps(path / "whole")
        self.damaged = 0
        self._most_bytes = most_bytes

    @property
    def strangers(self) -> dict[Path, int]:
        """Files by folder that look like details and are of another version, or damaged."""
        counts = {self.folder.path: self.folder.strangers, self.whole.path: len(self.whole.strangers)}
        return {path: count for path, count in counts.items() if count}

    @property
    def keys(self) -> list[Key]:
        """Submaps of which there may be details, in order."""
        return sorted({*self.folder.sizes, *self.whole.sizes})

    def keep(self, key: Key, submap: Submap, message: bytes) -> None:
        """Keep what the message of a submap leaves out; OSError if it cannot be written."""
        self.whole.add(key, submap, message)
        with suppress(OSError):  # a full disk: at the next one
            while self.whole.sizes and self.whole.total > self._most_bytes:
                self._pack(min(self.whole.sizes))

    def size(self, key: Key) -> int:
        """Bytes of details that are packed, 0 of others."""
        return self.folder.sizes.get(key, 0)

    def pack(self, key: Key) -> bool:
        """Have the details of a submap packed; False if there are none, OSError if they cannot be written."""
        return key in self.folder.sizes or (key in self.whole.sizes and self._pack(key))

    def read(self, key: Key) -> bytes | None:
        """The bytes of details that are packed; None if their file is gone."""
        try:
            return self.folder.read(key)
        except (OSError, ValueError):
            self.folder.sizes.pop(key, None)
            return None

    def close(self) -> None:
        """Let another process have the folder."""
        self.folder.close()

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
