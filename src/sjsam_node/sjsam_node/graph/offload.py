# SPDX-License-Identifier: Apache-2.0
"""Large arrays of old submaps on disk, in one file that nobody else sees and that ends with the process.

What is read stays in the process until the next submap comes: then the operating system alone decides what it keeps.
"""

from __future__ import annotations

import mmap
import tempfile
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np

from slam_core.types import AnyArray

_SEGMENT = 1 << 26
"""Bytes that are mapped at once: each mapping takes one of the files that a process may have open."""
_ALIGNMENT = 64


def forget(array: AnyArray) -> None:
    """Leave an array that :meth:`Offload.put` returned, and its neighbours, to the operating system; others stay."""
    if (owner := _mapping_of(array)) is not None:
        owner.madvise(mmap.MADV_DONTNEED)


def _mapping_of(array: AnyArray) -> mmap.mmap | None:
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if isinstance(owner, memoryview):
        owner = owner.obj
    return owner if isinstance(owner, mmap.mmap) else None


@dataclass
class Offload:
    """Arrays that are read from disk where they are used; the operating system keeps what is used often."""

    _file: IO[Any] = field(default_factory=tempfile.TemporaryFile)
    _segment: AnyArray = field(default_factory=lambda: np.empty(0, np.uint8))
    _mapped: list[mmap.mmap] = field(default_factory=list)
    _first: int = 0
    _end: int = 0

    def forget(self) -> None:
        """Leave what was read to the operating system; it is read again where it is used."""
        for segment in self._mapped:
            segment.madvise(mmap.MADV_DONTNEED)

    def _holds(self, array: AnyArray) -> bool:
        """True if an array is a view of one that :meth:`put` returned."""
        owner = _mapping_of(array)
        return any(owner is segment for segment in self._mapped)

    def put(self, array: AnyArray) -> AnyArray:
        """Array with these values, on disk and read only; one that is there already is returned as it is."""
        if not array.size or self._holds(array):
            return array
        if self._end + array.nbytes > self._first + len(self._segment):
            self._first += len(self._segment)
            self._end, size = self._first, max(_SEGMENT, -(-array.nbytes // _SEGMENT) * _SEGMENT)
            self._file.truncate(self._first + size)
            self._mapped.append(mmap.mmap(self._file.fileno(), size, prot=mmap.PROT_READ, offset=self._first))
            self._segment = np.frombuffer(self._mapped[-1], np.uint8)
        self._file.seek(self._end)
        self._file.write(np.ascontiguousarray(array).data)
        self._file.flush()
        at = self._end - self._first
        self._end += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
        return self._segment[at : at + array.nbytes].view(array.dtype).reshape(array.shape)
