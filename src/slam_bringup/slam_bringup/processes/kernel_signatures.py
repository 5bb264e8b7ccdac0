# SPDX-License-Identifier: Apache-2.0
"""Kernels compiled on all processors before anything is mapped, from a list of the arguments that they are called with.

Numba compiles a kernel at its first call, one after the other. ``kernel_signatures.json`` holds the types of those
calls, so that processes can share them; what else a kernel calls is compiled into it. An entry that fits no longer
costs time alone: the kernel is compiled at its first call, as without a list. ``slam warmup BAG --write`` writes it.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

from numba import types
from numba.core.dispatcher import Dispatcher

from slam_bringup.processes.inner_kernels import compile_in_full_only

SIGNATURES = Path(__file__).with_name("kernel_signatures.json")
"""Module → kernel → calls, each the list of its arguments' types."""
_PACKAGES = (
    "dense_mapping",
    "ekf_slam_node",
    "ndt_registration",
    "sjsam_node",
    "slam_core",
    "stereo_frontend",
    "tof_driver",
)
"""Packages with kernels that mapping needs."""
_PROCESS_BYTES = 1.2e9
"""Memory of a process that compiles: 1.1 GB for all kernels in one, and some room."""

Calls = dict[str, dict[str, list[list[Any]]]]


def compile_listed(on_module: Callable[[], None], calls: Calls) -> bool:
    """Compile ``calls`` in as many processes as there are processors and room; ``on_module`` is called after each.

    Returns whether all of them fit the kernels as they are; False too where a process was killed.
    """
    count = max(1, int(min(len(os.sched_getaffinity(0)), len(calls), _memory_left() / _PROCESS_BYTES)))
    fits = True
    names = {(module, name) for module, kernels in calls.items() for name in kernels}
    with ProcessPoolExecutor(count, get_context("spawn"), _begin, (names,)) as pool:
        try:
            for fit in pool.map(_compile_module, calls.items()):
                on_module()
                fits = fits and fit
        except BrokenProcessPool:  # most likely for want of memory
            return False
        except KeyboardInterrupt:
            for child in active_children():
                child.terminate()
            raise
    return fits


def _begin(names: set[tuple[str, str]]) -> None:
    """Prepare a process that compiles; it leaves Ctrl-C to the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    compile_in_full_only(names)


def _memory_left(meminfo: Path = Path("/proc/meminfo"), group: Path = Path("/sys/fs/cgroup")) -> float:
    """Bytes that processes can still take here, by the system and by the limit of a container (cgroup v2)."""
    left = float("inf")
    with suppress(OSError, StopIteration):
        line = next(one for one in meminfo.read_text().splitlines() if one.startswith("MemAvailable:"))
        left = 1024.0 * float(line.split()[1])
    with suppress(OSError, ValueError):  # no group, or one without a limit
        limit, used = ((group / name).read_text() for name in ("memory.max", "memory.current"))
        left = min(left, float(int(limit) - int(used)))
    return left


def _compile_module(calls: tuple[str, dict[str, list[list[Any]]]]) -> bool:
    module, kernels = calls
    try:
        for name, signatures in kernels.items():
            kernel = getattr(importlib.import_module(module), name)
            for arguments in signatures:
                kernel.compile(tuple(_type_of(one) for one in arguments))
    except Exception:
        # A renamed kernel or other arguments: whatever Numba makes of them, its first call compiles it.
        return False
    return True


def called_kernels() -> Calls:
    """Calls of kernels by Python in this process until now, and by kernels where it has compiled them."""
    calls: Calls = {}
    for module, name, kernel in _kernels():
        signatures = sorted([_text_of(one) for one in signature] for signature in kernel.overloads)
        if signatures:
            calls.setdefault(module, {})[name] = signatures
    return calls


def _kernels() -> Iterator[tuple[str, str, Any]]:
    for module in sorted(name for name in sys.modules if name.split(".")[0] in _PACKAGES):
        for name, value in sorted(vars(sys.modules[module]).items()):
            if isinstance(value, Dispatcher) and value.py_func.__module__ == module:
                yield module, name, value


def _text_of(kind: Any) -> Any:
    """Text of a type for JSON: its name, ``[dtype, dimensions, layout, writable]``, or ``[class or "", members]``."""
    if isinstance(kind, types.Array):
        return [_text_of(kind.dtype), kind.ndim, kind.layout, kind.mutable]
    if isinstance(kind, types.BaseTuple):
        members: Any = kind
        named = getattr(kind, "instance_class", None)
        return [f"{named.__module__}:{named.__qualname__}" if named else "", [_text_of(one) for one in members.types]]
    return str(kind)


def _type_of(text: Any) -> Any:
    if isinstance(text, str):
        return getattr(types, text if text != "bool" else "boolean")
    if len(text) == 2:
        name, members = text[0], [_type_of(one) for one in text[1]]
        named: Any = types
        if not name:
            return named.Tuple(members)
        module, _, qualified = name.partition(":")
        cls = getattr(importlib.import_module(module), qualified)
        alike = len(set(members)) == 1
        return named.NamedUniTuple(members[0], len(members), cls) if alike else named.NamedTuple(members, cls)
    dtype, dimensions, layout, writable = text
    return types.Array(_type_of(dtype), dimensions, layout, readonly=not writable)


def read_signatures() -> Calls:
    """Calls of the list; none where there is no list."""
    if not SIGNATURES.exists():
        return {}
    calls: Calls = json.loads(SIGNATURES.read_text(encoding="utf-8"))
    return calls


def write_signatures(calls: Calls) -> None:
    """Write the list beside this module, a line per kernel."""
    modules = []
    for module, kernels in calls.items():
        lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(signatures)}" for name, signatures in kernels.items())
        modules.append(f" {json.dumps(module)}: {{\n{lines}\n }}")
    SIGNATURES.write_text("{\n" + ",\n".join(modules) + "\n}\n", encoding="utf-8")
