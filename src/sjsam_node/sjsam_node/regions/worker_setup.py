# SPDX-License-Identifier: Apache-2.0
"""Setup of each worker of a Dask cluster, also of one that comes later or is started again; imports ``distributed``."""

from __future__ import annotations

import importlib
import platform
from importlib.metadata import version
from typing import Any

from distributed import Worker, WorkerPlugin

from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.version import VERSION

_LIBRARIES = ("numpy", "scipy", "numba")
"""Libraries that decide the last bits of a result."""


class Prepared(WorkerPlugin):
    """Gives each worker one thread of BLAS, unless its environment names a number, and has it load what tasks need."""

    name = "indoor-slam-prepared"

    def setup(self, worker: Worker) -> None:
        """Called on a worker before its first task."""
        use_one_blas_thread()
        importlib.import_module("sjsam_node.loop_closure.warm_up").warm_up()  # seconds, which no task has to wait for


def versions() -> dict[str, str]:
    """Versions of this program, Python, and the libraries that it computes with."""
    return {"this program": VERSION, "Python": platform.python_version()} | {name: version(name) for name in _LIBRARIES}


def other_versions(client: Any) -> list[str]:
    """A text for each version that a worker of a client's cluster has otherwise than this process."""
    own, out = versions(), list[str]()
    for worker, there in client.run(versions, on_error="return").items():
        if isinstance(there, BaseException):
            out.append(f"{worker} cannot run this program: {there}")
            continue
        out += [f"{worker} has {name} {there.get(name)}, here is {value}"
                for name, value in own.items() if there.get(name) != value]  # fmt: skip
    return out
