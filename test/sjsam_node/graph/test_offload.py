# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from sjsam_node.graph.offload import Offload


def test_arrays_on_disk_are_the_same_and_cannot_be_written(rng: np.random.Generator) -> None:
    disk = Offload()
    arrays = [rng.normal(size=(5, 7)), rng.normal(size=(3, 4)).astype(np.float32), np.empty((0, 128), np.float32)]
    stored = [disk.put(a) for a in arrays]
    for a, b in zip(arrays, stored, strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    with pytest.raises(ValueError, match="read-only"):
        stored[0][0, 0] = 1.0
