# SPDX-License-Identifier: Apache-2.0
"""Runs tasks in this process, or on the workers of a Dask cluster; the caller is the same.

    with cluster(scheduler, workers) as tasks:
        handle = tasks.submit(function, argument, other_handle)
        result, = tasks.gather([handle])

Functions are pure and give the same bytes wherever they run, as long as the workers' processors are of one kind.
"""

from __future__ import annotations

import os
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from slam_core.runtime.blas_threads import use_one_blas_thread


class Tasks(Protocol):
    """Runs functions; handles of results may be arguments of others."""

    def hold(self, value: Any) -> Any:
        """A handle of a value that several tasks take."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A handle of the result of a function."""

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results; what a task raised is raised here."""

    def channel(self, handler: Callable[[Any], None]) -> Callable[[Any], None]:
        """A function that tasks may be given to tell ``handler`` something while they run, numbers and texts alone.

        A task's first call comes from its own thread, later ones from any. What several tasks tell comes in any order.
        """


class InProcess:
    """Runs each function at once; a handle is the result itself."""

    def hold(self, value: Any) -> Any:
        """The value itself."""
        return value

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function."""
        return function(*arguments)

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The handles, which are the results."""
        return list(handles)

    def channel(self, handler: Callable[[Any], None]) -> Callable[[Any], None]:
        """The handler itself."""
        return handler


class OnCluster:
    """Runs functions on the workers of a Dask client; a lost worker's tasks run again on another one."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def hold(self, value: Any) -> Any:
        """A future of a value that is sent to the cluster once; the scheduler sends it again if its worker is lost."""
        with _told(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sending large graph")
            return self._client.submit(_same, value, pure=False)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A future of the result of a function."""
        with _told():
            return self._client.submit(function, *arguments, pure=False)

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results, once all are there.

        Raises
        ------
        ValueError
            If the cluster was lost, which ``hold`` and ``submit`` raise too, or the same task took several workers with
            it.
        """
        with _told():
            return list(self._client.gather(list(handles)))

    def channel(self, handler: Callable[[Any], None]) -> Callable[[Any], None]:
        """A function that logs an event of Dask's, which ``handler`` is told on a thread of the client."""
        topic = f"slam-{uuid.uuid4().hex}"
        with _told():
            self._client.subscribe_topic(topic, lambda event: handler(event[1]))
        return _Channel(topic)


@dataclass
class _Channel:
    """Tells the process that made it something from a worker."""

    topic: str
    _worker: Any = None

    def __call__(self, value: Any) -> None:
        if self._worker is None:  # only the task's own thread knows it
            from distributed import get_worker

            self._worker = get_worker()  # type: ignore[no-untyped-call]
        self._worker.log_event(self.topic, value)


@contextmanager
def _told() -> Iterator[None]:
    """Says in one line that the cluster was lost, or that a task takes workers with it."""
    from distributed import KilledWorker
    from distributed.client import ClosedClientError
    from distributed.comm.core import CommClosedError

    try:
        yield
    except KilledWorker as error:
        raise ValueError(
            "several workers ended at the same task, most likely for want of memory: start workers with more "
            f"(--memory-limit), or fewer a host: {error}"
        ) from error
    except (CommClosedError, CancelledError, ClosedClientError) as error:
        raise ValueError(f"the Dask cluster was lost: start it again, then the same command: {error}") from error


def _same(value: Any) -> Any:
    return value


@contextmanager
def cluster(scheduler: str | None = None, workers: int | None = None) -> Iterator[Tasks]:
    """Tasks run on the cluster of a ``scheduler``, on ``workers`` processes of this machine, or here.

    Without either there is one process for each processor, or none where ``distributed`` is not installed.

    Raises
    ------
    ValueError
        If both are given, or nobody answers at the scheduler's address, or its versions are others than here.
    ModuleNotFoundError
        If workers were asked for, and ``distributed`` is not installed.
    """
    if scheduler is not None and workers is not None:
        raise ValueError("name the scheduler of a cluster, or a number of workers here, not both")
    if scheduler is None and workers is None:
        workers = (os.cpu_count() or 1) if _has_distributed() else 0
    if workers == 0:
        yield InProcess()
        return
    with _client(scheduler, workers or 0) as client:
        yield OnCluster(client)


def _has_distributed() -> bool:
    try:
        import distributed  # noqa: F401
    except ModuleNotFoundError:
        return False
    return True


@contextmanager
def _client(scheduler: str | None, workers: int) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster  # a second to import, and needed here alone

    if scheduler is None:
        here = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
        with LocalCluster(**here) as local, Client(local) as client:  # type: ignore[no-untyped-call]
            client.run(use_one_blas_thread)
            yield client
        return
    try:
        client = Client(scheduler, timeout=_PATIENCE)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    with client, dask.config.set({"distributed.comm.timeouts.connect": _PATIENCE}):
        try:
            client.get_versions(check=True)  # type: ignore[no-untyped-call]
        except ValueError as error:
            raise ValueError(f"the cluster at {scheduler} has other versions than this program: {error}") from error
        if not client.scheduler_info()["workers"]:  # type: ignore[no-untyped-call]
            raise ValueError(f"the scheduler at {scheduler} has no workers: start them with 'dask worker {scheduler}'")
        client.run(use_one_blas_thread)  # type: ignore[no-untyped-call]
        yield client


_PATIENCE = "10s"
"""Time that a scheduler has to answer."""
