# SPDX-License-Identifier: Apache-2.0
"""A copy of the map on disk that is never much older than the map, so that a killed node goes on from it.

While a node lives its copy is at ``path``, which a lock that ends with the process keeps for it alone. One that ends in
order renames it to ``<path>.ended``; a copy still at ``path`` when a node starts is therefore that of a node that was
killed.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from sjsam_node.map_file import storage
from sjsam_node.map_file.storage import PackedMap, StoredMap
from slam_core.storage.files import PathLock, remove

_SHARE = 20.0
"""Writing takes at most one part in so many of the time."""


class Autosave:
    """Writes copies of a map, on a thread of its own, ``period_s`` apart or more where writing takes long.

    Times are those of any steady clock, s.

    Raises
    ------
    ValueError
        If another one that is open writes to the same path, or nothing can be written there.
    """

    def __init__(self, path: Path, period_s: float) -> None:
        self.path = path
        self.ended = path.with_name(f"{path.name}.ended")
        self._period_s = period_s
        self._lock = _lock(path)
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="autosave")
        self._job: Future[float] | None = None
        self._due_s = 0.0
        self._began_s = 0.0

    def found(self) -> Path | None:
        """The copy of a node that was killed, or None."""
        return self.path if storage.is_map(self.path) else None

    def is_due(self, now_s: float) -> bool:
        """True if the map is to be handed over now; raises what went wrong with the copy before."""
        if self._job is not None and self._job.done():
            job, self._job = self._job, None
            self._due_s = max(self._due_s, self._began_s + _SHARE * job.result())
        return self._job is None and now_s >= self._due_s

    def save(self, stored: StoredMap, now_s: float) -> None:
        """Write a copy of the map as it is now."""
        self._began_s, self._due_s = now_s, now_s + self._period_s
        self._job = self._writer.submit(self._write, storage.pack(stored))

    def _write(self, packed: PackedMap) -> float:
        """Write a copy; the time it took, s."""
        started = time.perf_counter()
        storage.write_packed(self.path, packed)
        return time.perf_counter() - started

    def retire(self) -> None:
        """Wait for the writer and rename the copy: the node ends in order, or its map was reset."""
        self.wait()
        if storage.is_map(self.path) and (storage.is_map(self.ended) or not self.ended.exists()):
            remove(self.ended)
            os.replace(self.path, self.ended)

    def wait(self) -> None:
        """Wait until the copy at hand is written."""
        if self._job is not None:
            self._job.exception()
            self._job = None

    def close(self) -> None:
        """End the writer's thread and give up the path."""
        self._writer.shutdown()
        self._lock.release()


def _lock(path: Path) -> PathLock:
    try:
        return PathLock(path)
    except ValueError as error:
        raise ValueError(f"{error}: set autosave_path to another place, or autosave_period_s to 0 for none") from None
