# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sjsam_node.graph.offload import Offload, forget

OPEN = Path("/proc/self/fd")


def test_arrays_on_disk_are_the_same_and_cannot_be_written(rng: np.random.Generator) -> None:
    disk = Offload()
    arrays = [rng.normal(size=(5, 7)), rng.normal(size=(3, 4)).astype(np.float32), np.empty((0, 128), np.float32)]
    stored = [disk.put(a) for a in arrays]
    for a, b in zip(arrays, stored, strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    with pytest.raises(ValueError, match="read-only"):
        stored[0][0, 0] = 1.0


@pytest.mark.skipif(not OPEN.exists(), reason="counts open files as Linux does")
def test_many_arrays_open_few_files(rng: np.random.Generator) -> None:
    disk, before = Offload(), len(list(OPEN.iterdir()))
    stored = [disk.put(np.full((k + 1, 3), k, np.int16)) for k in range(1200)]
    large = rng.integers(0, 255, (70, 1 << 20), np.uint8)
    on_disk = disk.put(large)
    assert len(list(OPEN.iterdir())) - before < 5
    assert all((a == k).all() and a.shape == (k + 1, 3) for k, a in enumerate(stored))
    assert np.array_equal(on_disk, large)


@pytest.mark.skipif(not OPEN.exists(), reason="counts resident pages as Linux does")
def test_what_was_read_is_left_to_the_system_and_read_again(rng: np.random.Generator) -> None:
    disk, large = Offload(), rng.integers(0, 255, (40, 1 << 20), np.uint8)
    on_disk = disk.put(large)
    assert np.array_equal(on_disk, large)
    read = _mapped_mib()
    disk.forget()
    assert _mapped_mib() < read - 30
    assert np.array_equal(on_disk, large)
    forget(on_disk[3:5])
    assert _mapped_mib() < read - 30
    assert np.array_equal(on_disk, large)


def test_an_array_that_is_not_on_disk_stays(rng: np.random.Generator) -> None:
    array = rng.normal(size=(5, 7))
    before = array.copy()
    forget(array[1:])
    assert np.array_equal(array, before)


def _mapped_mib() -> float:
    """Resident memory of this process that files hold, MiB."""
    (line,) = (row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("RssFile"))
    return int(line.split()[1]) / 1024


def test_what_is_on_disk_is_not_written_again(rng: np.random.Generator) -> None:
    disk, other = Offload(), Offload()
    stored = disk.put(rng.normal(size=(40, 40)))
    assert disk.put(stored) is stored
    part = stored[:10]
    assert disk.put(part) is part
    assert other.put(stored) is not stored
