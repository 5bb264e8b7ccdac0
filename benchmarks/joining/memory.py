# SPDX-License-Identifier: Apache-2.0
"""Peak memory of a stretch of a process (Linux): what was free before goes back to the system first."""

from __future__ import annotations

import ctypes
import gc
import re
from pathlib import Path


class PeakMemory:
    """``PeakMemory()`` starts a stretch, :meth:`grown` says by how many MiB the process grew at most since."""

    def __init__(self) -> None:
        gc.collect()
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew from here
        self._start = self._read("VmRSS")

    def grown(self) -> float:
        """MiB more than at the start, at most."""
        return self._read("VmHWM") - self._start

    @staticmethod
    def _read(field: str) -> float:
        found = re.search(rf"{field}:\s+(\d+) kB", Path("/proc/self/status").read_text())
        assert found is not None
        return int(found[1]) / 1024.0
