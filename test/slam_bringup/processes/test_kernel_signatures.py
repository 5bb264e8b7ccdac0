# SPDX-License-Identifier: Apache-2.0
"""Calls of kernels as text, compiled by other processes; the list of them is that of the kernels as they are."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import typeof

from demo_parts import cut
from slam_bringup.processes import kernel_signatures as listed

MAPPED = """
import json, sys
import slam_bringup.commands.warmup as warmup
from slam_bringup.processes.kernel_signatures import called_kernels
warmup.read_signatures = dict
warmup.command.main([sys.argv[1]], standalone_mode=False)
print(json.dumps(called_kernels()))
"""
KERNELS = """
from numba import njit

@njit(cache=True)
def doubled(values):
    return 2 * values

@njit(cache=True)
def longest(values):
    return doubled(values).max()
"""


class Pair(NamedTuple):
    first: np.ndarray
    second: object


FLOATS = np.zeros((2, 3))


@pytest.mark.parametrize(
    "value",
    [1, 1.5, True, FLOATS, FLOATS.T, FLOATS[::2, ::2], np.zeros(3, np.uint8), (1, 2.0), (1.0, 2.0), ((), (1,)),
     np.broadcast_to(FLOATS, (4, 2, 3)), Pair(FLOATS, FLOATS), Pair(FLOATS, 1),
     Pair(FLOATS, Pair(FLOATS, (FLOATS, 3)))],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_a_type_comes_back_from_its_text(value: object) -> None:
    kind = typeof(value)
    assert listed._type_of(json.loads(json.dumps(listed._text_of(kind)))) == kind


def test_listed_calls_are_compiled_and_kept_with_what_they_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "some_kernels.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    seen: list[None] = []
    call = [["float64", 1, "C", True]]
    assert listed.compile_listed(lambda: seen.append(None), {"some_kernels": {"longest": [call]}})
    assert len(seen) == 1
    assert _kept(tmp_path) == {"some_kernels.longest"}
    assert _called(tmp_path, "longest(x), longest.stats.cache_hits.total()") == "(4.0, 1)"
    assert _called(tmp_path, "int(doubled(x).sum())") == "6"


def test_listed_calls_are_compiled_with_what_the_cache_holds_already(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "some_kernels.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    call = [["float64", 1, "C", True]]
    for kernels in ({"doubled": [call]}, {"doubled": [call], "longest": [call]}):
        assert listed.compile_listed(lambda: None, {"some_kernels": kernels})
    assert _kept(tmp_path) == {"some_kernels.longest", "some_kernels.doubled"}
    hits = "longest.stats.cache_hits.total(), doubled.stats.cache_hits.total()"
    assert _called(tmp_path, f"longest(x), int(doubled(x).sum()), {hits}") == "(4.0, 6, 1, 1)"


def _kept(folder: Path) -> set[str]:
    return {path.name.split("-")[0] for path in (folder / "cache").rglob("*.nbc")}


def _called(folder: Path, expression: str) -> str:
    """What a new process prints for kernels called with [1, 2]."""
    script = "import numpy as np\nfrom some_kernels import doubled, longest\nx = np.array([1.0, 2.0])\n"
    script += f"print(({expression}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.mark.parametrize("calls", [{"none": [["int64"]]}, {"doubled": [["int64", "int64"]]}, {"doubled": [["int65"]]}])
def test_a_list_that_fits_no_longer_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls) -> None:
    (tmp_path / "some_kernels.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    sys.modules.pop("some_kernels", None)
    assert listed._compile_module(("some_kernels", {"doubled": [["int64"]]}))
    assert not listed._compile_module(("some_kernels", calls))


def test_a_process_that_is_killed_leaves_the_kernels_to_their_first_call(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "deadly_kernels.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert not listed.compile_listed(lambda: None, {"deadly_kernels": {"none": [["int64"]]}})


def test_ctrl_c_ends_all_processes_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = tmp_path / "went_on"
    (tmp_path / "slow_kernels.py").write_text(
        f"import pathlib, time\ntime.sleep(5)\npathlib.Path({str(mark)!r}).touch()\n"
    )
    (tmp_path / "quick_kernels.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(listed.os, "sched_getaffinity", lambda _: {0, 1})

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        listed.compile_listed(interrupt, {"quick_kernels": {}, "slow_kernels": {"none": [["int64"]]}})
    assert not mark.exists(), "the processes were waited for"


def test_memory_left_is_that_of_the_system_or_of_the_container(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemFree: 1 kB\nMemAvailable: 5 kB\n")
    assert listed._memory_left(tmp_path / "meminfo", tmp_path) == 5 * 1024
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("1000\n")
    assert listed._memory_left(tmp_path / "meminfo", tmp_path) == 5 * 1024
    (tmp_path / "memory.max").write_text("3000\n")
    assert listed._memory_left(tmp_path / "meminfo", tmp_path) == 2000
    assert listed._memory_left(tmp_path / "none", tmp_path / "none") == float("inf")


def test_every_listed_kernel_takes_as_many_arguments() -> None:
    calls = listed.read_signatures()
    assert len(calls) > 20
    for module, kernels in calls.items():
        for name, signatures in kernels.items():
            count = len(inspect.signature(getattr(importlib.import_module(module), name).py_func).parameters)
            assert {len(one) for one in signatures} == {count}, f"{module}.{name}: run `slam warmup bags/demo --write`"


def test_what_mapping_calls_is_in_the_list(tmp_path: Path) -> None:
    part = cut(tmp_path / "part", 0.0, 0.3)
    done = subprocess.run([sys.executable, "-c", MAPPED, str(part)], check=True, capture_output=True, text=True)
    calls = listed.read_signatures()
    called = json.loads(done.stdout.splitlines()[-1])
    assert {"ekf_slam_node", "ndt_registration", "stereo_frontend"} <= {name.split(".")[0] for name in called}
    missing = [
        (module, name)
        for module, kernels in called.items()
        for name, signatures in kernels.items()
        if any(one not in calls.get(module, {}).get(name, []) for one in signatures)
    ]
    assert missing == [], "run `slam warmup bags/demo --write`"
