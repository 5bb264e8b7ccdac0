# SPDX-License-Identifier: Apache-2.0
"""Setup of each worker of a Dask cluster, also of one that comes later or is started again; imports ``distributed``."""

from __future__ import annotations

import importlib
import logging
import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from distributed import Worker, WorkerPlugin

from sjsam_node.regions.tasks import NotAvailable
from slam_core.runtime.blas_threads import use_one_blas_thread
from slam_core.version import VERSION

_LOG = logging.getLogger(__name__)
_LIBRARIES = ("numpy", "scipy", "numba")
"""Libraries that decide the last bits of a result."""


def versions() -> dict[str, str]:
    """Versions of this program, Python, and the libraries that it computes with."""
    return {"this program": VERSION, "Python": platform.python_version()} | {name: version(name) for name in _LIBRARIES}


def _differing(there: dict[str, str], here: dict[str, str]) -> list[str]:
    """A text for each version that is not the same."""
    return [
        f"has {name} {there.get(name)}, here is {value}" for name, value in here.items() if there.get(name) != value
    ]


@dataclass
class Prepared(WorkerPlugin):
    """Gives each worker one thread of BLAS, unless its environment names a number, and has it load what tasks need.

    A worker of other versions than the process that made this leaves the cluster: it comes later than those that
    process has looked at.
    """

    wanted: dict[str, str] = field(default_factory=versions)
    name = "indoor-slam-prepared"

    def setup(self, worker: Worker) -> None:
        """Called on a worker before its first task."""
        if others := _differing(self.wanted, versions()):
            _LOG.error("this worker leaves: the program that uses the cluster %s; if that was updated, start the "
                       "scheduler again, too", "; ".join(others))  # fmt: skip
            worker.loop.add_callback(worker.close, reason="other versions")
            return
        use_one_blas_thread()
        importlib.import_module("sjsam_node.loop_closure.warm_up").warm_up()  # seconds, which no task has to wait for


def other_versions(client: Any) -> list[str]:
    """A text for each version that a worker of a client's cluster has otherwise than this process.

    Raises
    ------
    NotAvailable
        If a worker has gone meanwhile.
    """
    own, out = versions(), list[str]()
    for worker, there in client.run(versions, on_error="return").items():
        if isinstance(there, OSError):
            raise NotAvailable(f"a worker answers no more: {there}") from there
        if isinstance(there, BaseException):
            out.append(f"{worker} cannot run this program: {there}")
            continue
        out += [f"{worker} {other}" for other in _differing(there, own)]
    return out
