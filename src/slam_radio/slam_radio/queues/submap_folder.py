# SPDX-License-Identifier: Apache-2.0
"""A folder of submaps for the air, or of their details, one file each, that survives its process."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from slam_core.storage.files import PathLock, atomic_path, read_bytes
from slam_radio.packing.light_submap import MOST_BYTES, unpack
from slam_radio.wire.index_ranges import Key

_NAME = re.compile(r"(\d{1,10})-(\d{1,10})\.submap")


class SubmapFolder:
    """The submaps of one agent on disk: ``sizes`` has their keys and bytes.

    ``key_of``: session and index of what the bytes of a file hold, by default of a submap; ValueError if damaged.
    Files that it did not write, or that are damaged, are neither read nor removed; ``strangers`` counts them.

    Raises
    ------
    ValueError
        If another process keeps the folder, or it cannot be read or written.
    """

    def __init__(self, path: Path, key_of: Callable[[bytes], Key] | None = None) -> None:
        self.path, self._key_of = path, key_of or _submap_key
        self._lock = PathLock(path)
        self.sizes: dict[Key, int] = {}
        self.strangers = 0
        path.mkdir(parents=True, exist_ok=True)
        for file in sorted(path.iterdir()):
            match = _NAME.fullmatch(file.name)
            if match and self._is_ours(file, (int(match[1]), int(match[2]))):
                self.sizes[int(match[1]), int(match[2])] = file.stat().st_size
            else:
                self.strangers += match is not None

    def add(self, key: Key, data: bytes) -> None:
        """Write a submap, whole or not at all."""
        file = self._file(key)
        if file.exists() and key not in self.sizes:
            raise ValueError(f"{file} is not a submap of this program: move it away")
        with atomic_path(file) as temporary:
            temporary.write_bytes(data)
        self.sizes[key] = len(data)

    def read(self, key: Key) -> bytes:
        """The bytes of a submap; ValueError or OSError if somebody has taken or changed the file."""
        return read_bytes(self._file(key), MOST_BYTES)

    def remove(self, key: Key) -> None:
        """Remove a submap that is there."""
        del self.sizes[key]
        self._file(key).unlink(missing_ok=True)

    def close(self) -> None:
        """Let others have the folder."""
        self._lock.release()

    def _file(self, key: Key) -> Path:
        return self.path / f"{key[0]}-{key[1]}.submap"

    def _is_ours(self, file: Path, key: Key) -> bool:
        try:
            return self._key_of(read_bytes(file, MOST_BYTES)) == key
        except (ValueError, OSError):
            return False


def _submap_key(data: bytes) -> Key:
    submap = unpack(data)
    return submap.session, submap.index
