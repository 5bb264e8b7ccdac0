# SPDX-License-Identifier: Apache-2.0
"""The heap of a process: shared by its threads, and given back."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import resource, threading
import numpy as np
from slam_core.runtime.memory import share_one_heap

def resident_mib():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 2**20

share_one_heap()
at_first = resident_mib()
def fill():
    sum(array[0] for array in [np.ones(100_000) for _ in range(120)])
grown = []
for _ in range(4):
    thread = threading.Thread(target=fill)
    thread.start()
    thread.join()
    grown.append(resident_mib() - at_first)
print(*grown)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the C library of Linux")
def test_a_thread_takes_what_another_one_has_freed() -> None:
    first, *later = map(float, subprocess.check_output([sys.executable, "-c", SCRIPT], text=True).split())
    assert max(later) < first + 5.0


def test_what_is_loaded_is_not_searched_for_garbage_and_cycles_made_later_are() -> None:
    script = """
import gc, weakref
from slam_core.runtime.memory import search_less_garbage
class Knot: pass
search_less_garbage()
knot = Knot(); knot.itself = knot
left = weakref.ref(knot); del knot
rooms = [[] for _ in range(50_000)]
print(gc.get_freeze_count() > 1000, left() is None)
"""
    assert subprocess.check_output([sys.executable, "-c", script], text=True).split() == ["True", "True"]


LIBRARIES = """
import re
import numpy as np
import scipy.linalg
from slam_core.runtime.memory import leave_libraries

def of_files_mib():
    return int(re.search(r"RssFile:\\s+(\\d+)", open("/proc/self/status").read())[1]) / 1024

before = scipy.linalg.solve(np.eye(30) + 1.0, np.arange(30.0))
loaded = of_files_mib()
leave_libraries()
left = of_files_mib()
after = scipy.linalg.solve(np.eye(30) + 1.0, np.arange(30.0))
print(loaded, left, np.array_equal(before, after))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of Linux")
def test_libraries_work_as_before_after_their_code_was_left_to_the_system() -> None:
    loaded, left, is_same = subprocess.check_output([sys.executable, "-c", LIBRARIES], text=True).split()
    assert float(left) < 0.6 * float(loaded)
    assert is_same == "True"


HEAP = """
import re
import numpy as np
from slam_core.runtime.memory import share_one_heap, trim_heap

def own_mib():
    return int(re.search(r"RssAnon:\\s+(\\d+)", open("/proc/self/status").read())[1]) / 1024

share_one_heap()
at_first = own_mib()
images, last = [np.ones(100_000) for _ in range(60)], np.ones(100_000)
del images
free = own_mib()
trim_heap()
print(free - at_first, own_mib() - at_first, last.sum())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the C library of Linux")
def test_what_is_free_below_something_in_use_goes_back_to_the_system() -> None:
    free, trimmed, total = map(float, subprocess.check_output([sys.executable, "-c", HEAP], text=True).split())
    assert free > 40.0
    assert trimmed < 10.0
    assert total == 100_000.0
