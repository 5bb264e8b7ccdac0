# SPDX-License-Identifier: Apache-2.0
"""A Dask cluster of this machine whose processes are killed and started again."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

distributed = pytest.importorskip("distributed")


class Cluster:
    """A scheduler, at one address whenever it is started, and its workers; all are processes without a nanny."""

    def __init__(self, workers: int) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            port = int(taken.getsockname()[1])
        self.address = f"tcp://127.0.0.1:{port}"
        self._scheduler = ["distributed.cli.dask_scheduler", "--port", str(port), "--no-dashboard"]
        self._worker = [
            "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"
        ]  # fmt: skip
        self._workers = workers
        self._running: list[subprocess.Popen[Any]] = []

    def start(self, *, is_awaited: bool = True) -> None:
        """Start all."""
        here = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        here["PYTHONPATH"] = os.pathsep.join(sys.path)
        commands = [self._scheduler, *[self._worker] * self._workers]
        self._running = [subprocess.Popen([sys.executable, "-m", *command], env=here, stderr=subprocess.DEVNULL)
                         for command in commands]  # fmt: skip
        if is_awaited:
            with distributed.Client(self.address, timeout=60, set_as_default=False) as client:
                client.wait_for_workers(self._workers, timeout=60)

    def run_on_workers(self, code: str) -> None:
        """Run Python code in each worker."""
        with distributed.Client(self.address, timeout=60, set_as_default=False) as client:
            client.run(exec, code)

    def kill(self) -> None:
        """Kill all with signal 9."""
        while self._running:
            self.kill_worker()

    def kill_worker(self) -> None:
        """Kill the last of the workers with signal 9, the scheduler where none is left."""
        process = self._running.pop()
        process.kill()
        process.wait()


@contextmanager
def running_cluster(workers: int = 1) -> Iterator[Cluster]:
    """A cluster that runs, killed in the end."""
    own = Cluster(workers)
    try:
        own.start()
        yield own
    finally:
        own.kill()
