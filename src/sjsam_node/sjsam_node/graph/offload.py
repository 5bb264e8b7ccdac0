# SPDX-License-Identifier: Apache-2.0
"""Large arrays of old submaps on disk, in one file that nobody else sees and that ends with the process."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np

from slam_core.types import AnyArray


@dataclass
class Offload:
    """Arrays that are read from disk where they are used; the operating system keeps what is used often."""

    _file: IO[Any] = field(default_factory=tempfile.TemporaryFile)

    def put(self, array: AnyArray) -> AnyArray:
        """The same array, on disk and read only."""
        if not array.size:
            return array
        start = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(array).data)
        self._file.flush()
        return np.asarray(np.memmap(self._file, array.dtype, "r", start, array.shape))
