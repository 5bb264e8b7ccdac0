# SPDX-License-Identifier: Apache-2.0
"""Kernels from the cache: their machine code works, and their LLVM code is there for who compiles a caller."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = """
import numpy as np
from numba import njit
import slam_core.runtime.in_place

@njit(cache=True)
def twice(values):
    return [2 * v for v in values]

@njit(cache=True)
def total(values):
    return sum(twice(values)) + np.zeros(3).sum()
"""
SCRIPT = """
import sys
from kernels import total, twice
from numba import njit
print(sum(twice([1.0, 2.0])), total([1.0, 2.0]))
libraries = [kernel.overloads[kernel.signatures[0]].library for kernel in (twice, total)]
print(sum(kernel.stats.cache_hits[s] for kernel in (twice, total) for s in kernel.stats.cache_hits))
print(sum(library._shared_module is None or not list(library._shared_module.functions) for library in libraries))
print("numba.np.arrayobj" in sys.modules)
caller = njit(lambda values: total(values) + 1.0)
print(caller([1.0, 2.0]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="object files of Linux")
def test_kernels_from_the_cache_hold_no_llvm_code_and_can_be_called_by_new_ones(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    for hits, bare, has_numbas_modules in ((0, 0, True), (2, 2, False)):
        lines = subprocess.check_output([sys.executable, "-c", SCRIPT], text=True, cwd=tmp_path).splitlines()
        assert lines == ["6.0 6.0", str(hits), str(bare), str(has_numbas_modules), "7.0"]
