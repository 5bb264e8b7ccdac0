# SPDX-License-Identifier: Apache-2.0
"""Runs tasks in this process, or on the workers of a Dask cluster; the caller is the same.

    with cluster(scheduler, workers) as tasks:
        handle = tasks.submit(function, argument, other_handle)
        result, = tasks.gather([handle])

Functions are pure and give the same bytes wherever they run, as long as the workers' processors are of one kind.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import time
import uuid
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
_PATIENCE_S = 10.0
"""Time that a scheduler has to answer, s."""
_RETURN_S = 60.0
"""Time within which a cluster that was lost has to be back, s."""


class Tasks(Protocol):
    """Runs functions; handles of results may be arguments of others."""

    def hold(self, value: Any) -> Any:
        """A handle of a value that several tasks take."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A handle of the result of a function."""

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results; what a task raised is raised here."""


class TellingTasks(Tasks, Protocol):
    """Tasks that may say something while they run."""

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


class ClusterLost(ValueError):
    """The scheduler, or the link to it, is gone, and with it all results."""


class WorkersKilled(ValueError):
    """Several workers ended at the same task."""


class NotAvailable(ValueError):
    """Nobody answers at a scheduler's address, or it has no workers."""


@dataclass(eq=False)
class _Task:
    """A function and its arguments, other tasks among them; kept so that it can be given to a cluster once more.

    number: in the order in which they were submitted; future: of the result, on the cluster of ``client``, until nobody
    can ask for it any more; is_asked_for: somebody can, who has not been given the result yet.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    number: int
    future: Any = None
    client: Any = None
    is_asked_for: bool = True

    def let_go(self) -> None:
        """Let the cluster drop the result; tasks that need it have it there."""
        self.future, self.is_asked_for = None, False


@dataclass(frozen=True, eq=False)
class _Handle:
    """Keeps the result of a task on the cluster, and asks for it."""

    task: _Task


class OnCluster:
    """Runs functions on the workers of a Dask client; a lost worker's tasks run again on another one.

    Parameters
    ----------
    client
        A client of the cluster.
    again
        Gives a client of the cluster that was started again after it was lost: all tasks whose results may still be
        asked for run once more there. Without it a lost cluster ends the work.
    wait_s
        Time within which the next result has to be computed, and all of them fetched, s; any by default.
    """

    def __init__(self, client: Any, again: Callable[[], Any] | None = None, wait_s: float | None = None) -> None:
        self._client, self._again, self._wait_s = client, again, wait_s
        self._tasks, self._number = weakref.WeakSet[_Task](), itertools.count()
        self._lost: ClusterLost | None = None
        self._channels: list[tuple[str, Callable[[Any], None]]] = []

    def hold(self, value: Any) -> Any:
        """A handle of a value that is sent to the cluster once; it is sent again if its worker is lost."""
        return self.submit(unchanged, value)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A handle of the result of a function."""
        own = tuple(a.task if isinstance(a, _Handle) else a for a in arguments)
        task = _Task(function, own, next(self._number))
        self._surviving(lambda: self._future(task))
        self._tasks.add(task)
        handle = _Handle(task)
        weakref.finalize(handle, task.let_go).atexit = False
        return handle

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results, once all are there.

        Raises
        ------
        ClusterLost
            If the cluster was lost for good, which ``hold`` and ``submit`` raise too.
        WorkersKilled
            If the same task took several workers with it.
        TimeoutError
            If results were not there in time.
        """
        results = self._surviving(lambda: self._results([self._future(handle.task) for handle in handles]))
        for handle in handles:
            handle.task.is_asked_for = False
        return results

    def channel(self, handler: Callable[[Any], None]) -> Callable[[Any], None]:
        """A function that logs an event of Dask's, which ``handler`` is told on a thread of the client."""
        self._channels.append((f"slam-{uuid.uuid4().hex}", handler))
        self._surviving(lambda: self._listen(*self._channels[-1]))
        return _Channel(self._channels[-1][0])

    def close(self, timeout_s: float | None = None) -> None:
        """Leave the cluster, which has some time for it, s."""
        self._client.close(**({} if timeout_s is None else {"timeout": timeout_s}))

    def _results(self, futures: list[Any]) -> list[Any]:
        if self._wait_s is None:
            return list(self._client.gather(futures))
        from distributed import wait

        left = futures
        with self._client.as_current():
            while left:  # as long as one after the other comes
                left = list(wait(left, self._wait_s, "FIRST_COMPLETED").not_done)  # type: ignore[no-untyped-call]
        fetch = partial(self._client.gather, asynchronous=True)  # a result whose worker dies now may never come
        return list(self._client.sync(fetch, futures, callback_timeout=self._wait_s))

    def _listen(self, topic: str, handler: Callable[[Any], None]) -> None:
        self._client.subscribe_topic(topic, lambda event: handler(event[1]))

    def _future(self, task: _Task) -> Any:
        """The future of a task; it is given to the cluster first if this one does not know it."""
        if task.client is not self._client:
            arguments = [self._future(a) if isinstance(a, _Task) else a for a in task.arguments]
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sending large graph")
                task.future = self._client.submit(task.function, *arguments, pure=False)
            task.client = self._client
        return task.future

    def _surviving(self, ask: Callable[[], T]) -> T:
        """The result of asking the cluster, also if it is started again meanwhile."""
        while True:
            if self._lost is not None:
                raise ClusterLost(str(self._lost))
            try:
                with _told():
                    return ask()
            except ClusterLost as lost:
                if self._again is None:
                    raise
                _LOG.warning("the Dask cluster was lost; its work is done again once it is back")
                self._go_on(self._again, lost)

    def _go_on(self, again: Callable[[], Any], lost: ClusterLost) -> None:
        """Give the cluster as it is now all that the one before was asked for; where there is none, never ask again."""
        with suppress(Exception):  # what is lost cannot always be left in good order
            self._client.close(timeout=1)
        try:
            self._client = again()
        except ValueError as error:
            self._lost = lost
            raise lost from error
        with suppress(ClusterLost), _told():  # lost once more: whoever asks next finds out
            for topic, handler in self._channels:
                self._listen(topic, handler)
            for task in sorted(self._tasks, key=lambda one: one.number):
                if task.is_asked_for:
                    self._future(task)


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
        raise WorkersKilled(
            "several workers ended at the same task, most likely for want of memory: start workers with more "
            f"(--memory-limit), or fewer a host: {error}"
        ) from error
    except (CommClosedError, CancelledError, ClosedClientError) as error:
        raise ClusterLost(f"the Dask cluster was lost: start it again, then the same command: {error}") from error


def unchanged(value: Any) -> Any:
    """The value itself: a task that only brings it to the cluster."""
    return value


@contextmanager
def cluster(scheduler: str | None = None, workers: int | None = None) -> Iterator[TellingTasks]:
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
    with _of_this_machine(workers or 0) if scheduler is None else _of_scheduler(scheduler) as tasks:
        yield tasks


def _has_distributed() -> bool:
    try:
        import distributed  # noqa: F401
    except ModuleNotFoundError:
        return False
    return True


@contextmanager
def _of_this_machine(workers: int) -> Iterator[OnCluster]:
    from distributed import Client, LocalCluster  # a second to import, and needed here alone

    from sjsam_node.regions.worker_setup import Prepared

    here = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with LocalCluster(**here) as local, Client(local) as client:  # type: ignore[no-untyped-call]
        client.register_plugin(Prepared())
        yield OnCluster(client)


@contextmanager
def _of_scheduler(address: str) -> Iterator[OnCluster]:
    import dask

    with dask.config.set({"distributed.comm.timeouts.connect": f"{_PATIENCE_S:.0f} s"}):
        tasks = OnCluster(connected(address), partial(connected_again, address))
        try:
            yield tasks
        finally:
            tasks.close()


def connected(address: str) -> Any:
    """A client of the scheduler at an address, whose workers are set up.

    Raises
    ------
    NotAvailable
        If nobody answers there, or it has no workers, or they cannot be set up now.
    ValueError
        If scheduler or workers have other versions of Dask, Python, NumPy, SciPy, Numba or this program.
    """
    from distributed import Client

    from sjsam_node.regions.worker_setup import Prepared, other_versions

    try:
        asyncio.run(_greet(address))
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise NotAvailable(f"no Dask scheduler answers at {address}: {error}") from error
    try:
        client.get_versions(check=True)  # type: ignore[no-untyped-call]
        if not client.scheduler_info()["workers"]:  # type: ignore[no-untyped-call]
            raise NotAvailable(f"the scheduler at {address} has no workers: start them with 'dask worker {address}'")
        if others := other_versions(client):
            raise ValueError("; ".join(others))
        client.register_plugin(Prepared())
    except NotAvailable:
        client.close()  # type: ignore[no-untyped-call]
        raise
    except ValueError as error:
        client.close()  # type: ignore[no-untyped-call]
        raise ValueError(f"the cluster at {address} has other versions than this program: {error}") from error
    except (OSError, TimeoutError) as error:
        client.close()  # type: ignore[no-untyped-call]
        raise NotAvailable(f"the Dask scheduler at {address} answers no more: {error}") from error
    except Exception as error:  # of a worker, whatever it is
        client.close()  # type: ignore[no-untyped-call]
        raise NotAvailable(f"the workers of the Dask scheduler at {address} cannot be set up: {error}") from error
    return client


async def _greet(address: str) -> None:
    """Connect to a scheduler and leave; a client that cannot connect would leave a thread behind each time."""
    from distributed.comm.core import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")  # type: ignore[no-untyped-call]
    async with asyncio.timeout(1.1 * _PATIENCE_S):  # Dask's own does not end where somebody listens and says nothing
        comm = await connect(address, timeout=_PATIENCE_S, **arguments)  # type: ignore[no-untyped-call]
    comm.abort()


def connected_again(address: str) -> Any:
    """A client of the scheduler at an address as soon as it and a worker are there again."""
    deadline = time.monotonic() + _RETURN_S
    while True:
        try:
            return connected(address)
        except (ValueError, OSError, TimeoutError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
