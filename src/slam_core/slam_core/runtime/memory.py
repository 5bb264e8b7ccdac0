# SPDX-License-Identifier: Apache-2.0
"""Settings of the C library's memory allocator (glibc; elsewhere unchanged) and of Python's search for garbage.

Every frame makes and frees images and matrices. By default each thread keeps a heap of its own for them, and what is
larger than some size is asked for and given back every time. One heap for all threads takes less memory; not giving
back what the next frame will ask for again saves the time to clear it.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
"""Parameters of ``mallopt`` (malloc.h)."""
_KEPT_BYTES = 64 << 20
_LARGE_BYTES = 8 << 20
_CLEAN_PART = re.compile(
    rb"^(?P<first>[0-9a-f]+)-(?P<end>[0-9a-f]+) r-[x-]p .*\.so.*\n"  # addresses, rights, ..., name
    rb"(?:[A-Z].*\n)*?Anonymous: +0 kB",
    re.MULTILINE,
)
"""A part of a library, read only, without a page of the process's own, in ``smaps`` (proc(5))."""
_NEW_OBJECTS = 10_000
"""Objects made, less those freed, that begin a search for garbage; Python has 700."""


@cache
def _glibc() -> Any:
    """The C library, or None where it is another one."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return library if library is not None and hasattr(library, "mallopt") else None


def share_one_heap() -> None:
    """Have all threads use one heap and keep up to 64 MiB of what they free; call it before there are threads.

    Without it ``slam run`` of 200 frames of a depth camera with scan odometry takes 350 MB, not 301, in the same time.
    """
    library = _glibc()
    if library is None:
        return
    for parameter, value in ((_ARENA_MAX, 1), (_MMAP_THRESHOLD, _LARGE_BYTES), (_TRIM_THRESHOLD, _KEPT_BYTES)):
        library.mallopt(parameter, value)


def search_less_garbage() -> None:
    """Leave all that is loaded so far out of the search for garbage, and search less often: 3 % of a run's time."""
    gc.freeze()
    gc.set_threshold(_NEW_OBJECTS)
    gc.enable()


def leave_libraries() -> None:
    """Leave code and tables of the loaded libraries to the system, 80 to 110 MB; what is needed is read again.

    That is little of it: most has served to load modules and kernels, above all LLVM's 70 MB. Takes 20 ms. Without it
    ``slam run bags/demo`` takes 360 MB instead of 280, in the same time.
    """
    library = _glibc()
    if library is not None:
        for first, end in _clean_parts_of_libraries():
            library.madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), mmap.MADV_DONTNEED)


def trim_heap() -> None:
    """Give the system what is free in the heap, 1 to 6 ms: for where one kind of work ends and another begins.

    What the next frame asks for again is kept otherwise (:func:`share_one_heap`), up to 100 MB after mapping.
    """
    library = _glibc()
    if library is not None:
        library.malloc_trim(ctypes.c_size_t(0))


def _clean_parts_of_libraries() -> Iterator[tuple[int, int]]:
    """Addresses (first, end) of parts of libraries that are as in their files: no page was written to."""
    for found in _CLEAN_PART.finditer(Path("/proc/self/smaps").read_bytes()):
        yield int(found["first"], 16), int(found["end"], 16)
