# SPDX-License-Identifier: Apache-2.0
"""Views on disk, one file each, up to a number of bytes; the oldest go first."""

from __future__ import annotations

import re
from bisect import bisect_left, insort
from contextlib import suppress
from pathlib import Path

from slam_core.storage.files import PathLock, atomic_path, read_bytes
from slam_radio.views.view_format import KINDS, MAGIC, MOST_BYTES, VERSION, PlacedImage, unpack_view
from slam_radio.wire.view_messages import ViewKey

_NAME = re.compile(r"([12])-(\d{1,10})-(\d{1,19})\.view")
_BEGINNING = MAGIC + bytes([VERSION])


class ViewFiles:
    """The views of one agent: ``sizes`` has their keys, with the stamps of their images, and their bytes.

    ``strangers`` counts files of another version: they stay, and count in ``most_bytes``. ``bytes``: of all.

    Raises
    ------
    ValueError
        If another process keeps the folder, or it cannot be read or written.
    """

    def __init__(self, path: Path, most_bytes: float) -> None:
        self.path, self._most_bytes = path, most_bytes
        self._lock = PathLock(path)
        path.mkdir(parents=True, exist_ok=True)
        self.sizes: dict[ViewKey, int] = {}
        self.strangers, self.bytes = 0, 0
        self._by_age: list[tuple[int, int, int]] = []
        """Session, stamp and kind of every key, oldest first."""
        for file in sorted(path.iterdir()):
            if match := _NAME.fullmatch(file.name):
                self._find(file, ViewKey(int(match[1]), int(match[2]), int(match[3])))

    def _find(self, file: Path, key: ViewKey) -> None:
        with file.open("rb") as stream:
            is_ours = stream.read(len(_BEGINNING)) == _BEGINNING
        size = file.stat().st_size
        self.bytes += size
        if is_ours:
            self._note(key, size)
        else:
            self.strangers += 1

    def _note(self, key: ViewKey, size: int) -> None:
        self.sizes[key] = size
        insort(self._by_age, _age(key))

    def _forget(self, key: ViewKey) -> int:
        """Bytes of a view that is looked at no more."""
        del self._by_age[bisect_left(self._by_age, _age(key))]
        return self.sizes.pop(key)

    def add(self, key: ViewKey, data: bytes) -> None:
        """Keep a view, whole or not at all, and forget the oldest beyond the limit; OSError if that fails."""
        file = self._file(key)
        if file.exists() and key not in self.sizes:
            raise ValueError(f"{file} is not a view of this program: move it away")
        with atomic_path(file) as temporary:
            temporary.write_bytes(data)
        if key in self.sizes:
            self.bytes -= self._forget(key)
        self._note(key, len(data))
        self.bytes += len(data)
        while self.bytes > self._most_bytes and self._by_age:
            session, stamp, kind = self._by_age[0]
            self.remove(ViewKey(kind, session, stamp))

    def nearest(self, key: ViewKey, within_ns: int) -> ViewKey | None:
        """Key of the view of a kind and session whose image is nearest to a stamp; None if none is near."""
        same = [k for k in self.sizes if (k.kind, k.session) == (key.kind, key.session)]
        best = min(same, key=lambda k: (abs(k.stamp_ns - key.stamp_ns), k.stamp_ns), default=None)
        return best if best is not None and abs(best.stamp_ns - key.stamp_ns) <= within_ns else None

    def read(self, key: ViewKey) -> tuple[PlacedImage, bytes]:
        """A view and its bytes; ValueError or OSError if its file is damaged, gone, or holds another one."""
        data = read_bytes(self._file(key), MOST_BYTES)
        view = unpack_view(data)
        if (view.kind, view.session, view.stamp_ns) != key:
            raise ValueError(f"{self._file(key)} holds the {KINDS[view.kind]} of {view.session}/{view.stamp_ns}")
        return view, data

    def set_aside(self, key: ViewKey) -> None:
        """Look at a file that cannot be read no more; it stays, if there is one."""
        self.bytes -= self._forget(key)
        self.strangers += 1
        with suppress(FileNotFoundError):
            self.bytes += self._file(key).stat().st_size

    def remove(self, key: ViewKey) -> None:
        """Remove a view that is there."""
        self.bytes -= self._forget(key)
        self._file(key).unlink(missing_ok=True)

    def close(self) -> None:
        """Let another process have the folder."""
        self._lock.release()

    def _file(self, key: ViewKey) -> Path:
        return self.path / f"{key.kind}-{key.session}-{key.stamp_ns}.view"


def _age(key: ViewKey) -> tuple[int, int, int]:
    return key.session, key.stamp_ns, key.kind
