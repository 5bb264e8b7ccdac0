"""Arrays that grow at the end: room is doubled when it runs out, so that appending costs what is appended."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from slam_core.block_pattern import IntArray


class Growing:
    """Entries of one shape along the first axis of an array."""

    def __init__(self, dtype: npt.DTypeLike, shape: tuple[int, ...] = ()) -> None:
        self._room = np.empty((0, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def data(self) -> npt.NDArray[Any]:
        """What is there, as a view that may be written to."""
        return self._room[: self._count]

    def extend(self, values: npt.NDArray[Any]) -> None:
        """Append along the first axis."""
        self.more(len(values))[:] = values

    def more(self, count: int) -> npt.NDArray[Any]:
        """Append so many entries, to be written by the caller."""
        end = self._count + count
        if end > len(self._room):
            room = np.empty((max(2 * len(self._room), end), *self._room.shape[1:]), self._room.dtype)
            room[: self._count] = self.data
            self._room = room
        self._count = end
        return self._room[end - count : end]

    def fork(self) -> Growing:
        """The same entries without copying them: one of the two may go on growing, and neither writes to old ones."""
        other = Growing.__new__(Growing)
        other._room, other._count = self._room, self._count
        return other

    def copy(self) -> Growing:
        """Entries of its own."""
        other = self.fork()
        other._room = self.data.copy()
        return other


class GrowingRuns:
    """Runs of values one after the other: run k is ``data[ptr[k] : ptr[k + 1]]``."""

    def __init__(self, dtype: npt.DTypeLike) -> None:
        self._data, self._ptr = Growing(dtype), Growing(np.int64)
        self._ptr.extend(np.zeros(1, dtype=np.int64))

    def __len__(self) -> int:
        return len(self._ptr) - 1

    def __getitem__(self, run: int) -> npt.NDArray[Any]:
        return self.data[self.ptr[run] : self.ptr[run + 1]]

    @property
    def data(self) -> npt.NDArray[Any]:
        """All runs."""
        return self._data.data

    @property
    def ptr(self) -> IntArray:
        """Where each starts, and the end."""
        return self._ptr.data

    def sizes(self, runs: IntArray) -> IntArray:
        """Lengths of some runs."""
        return np.asarray(self.ptr[runs + 1] - self.ptr[runs])

    def extend(self, values: npt.NDArray[Any], ptr: IntArray) -> None:
        """Append runs that are given one after the other."""
        self.more(ptr)[:] = values

    def more(self, ptr: IntArray) -> npt.NDArray[Any]:
        """Append runs, to be written by the caller."""
        self._ptr.extend(ptr[1:] + len(self._data))
        return self._data.more(int(ptr[-1]))

    def fork(self) -> GrowingRuns:
        """As :meth:`Growing.fork`."""
        other = GrowingRuns.__new__(GrowingRuns)
        other._data, other._ptr = self._data.fork(), self._ptr.fork()
        return other

    def copy(self) -> GrowingRuns:
        """Values of its own."""
        other = self.fork()
        other._data = self._data.copy()
        return other
