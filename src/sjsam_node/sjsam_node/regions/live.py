# SPDX-License-Identifier: Apache-2.0
"""Runs tasks on a Dask cluster that may come and go: what it does not give in time is done in this process.

    tasks = LiveTasks("tcp://192.168.1.10:8786")
    handle = tasks.submit(function, argument)
    result, = tasks.gather([handle])

Functions are pure, so that a task may run twice, and anywhere. A worker that dies is Dask's matter: its tasks run again
on another one. Where none does within :data:`WAIT_S`, or the scheduler is gone, they run here, and so does all that
comes, until the cluster answers again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Self

from sjsam_node.regions.tasks import ClusterLost, NotAvailable, OnCluster, WorkersKilled, connected, unchanged

_LOG = logging.getLogger(__name__)
WAIT_S = 5.0
"""Time within which the cluster has to give the next result, s."""
_RETRY_S = 2.0
"""Time between two looks for a cluster that does not answer, s."""
_MOST_DOUBLINGS = 8
"""Of that time, before the first look for a cluster that was too slow again and again."""


@dataclass(eq=False)
class _Work:
    """A function and its arguments, other work among them.

    there: handle of its result on a ``cluster``; here: the result of this process, once it had to compute it.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    there: Any = None
    cluster: OnCluster | None = None
    here: list[Any] = field(default_factory=list)

    def value(self) -> Any:
        """The result, computed here."""
        if not self.here:
            self.here.append(self.function(*[a.value() if isinstance(a, _Work) else a for a in self.arguments]))
        return self.here[0]


class LiveTasks:
    """Tasks of a live map; one thread submits and gathers.

    Attributes
    ----------
    elsewhere, here
        Number of results that the cluster gave, and of those that this process computed in its place.

    Parameters
    ----------
    address
        Of the scheduler.

    Raises
    ------
    ValueError
        If the cluster there has other versions than this program, or ``distributed`` is not installed.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._cluster: OnCluster | None = None
        self.elsewhere = self.here = self._timeouts = 0
        self._ended = threading.Event()
        try:
            self._cluster = OnCluster(connected(address), wait_s=WAIT_S)
        except NotAvailable as error:
            _LOG.warning("%s; submaps are joined in this process until it does", error)
            self._look_for_it()
        except ModuleNotFoundError as error:
            raise ValueError(f"scheduler needs Dask: pip install 'indoor-slam[scale]' ({error})") from error

    @classmethod
    def at(cls, address: str) -> Self | None:
        """Tasks on the cluster of a scheduler; None for no address."""
        return cls(address) if address else None

    @property
    def is_connected(self) -> bool:
        """True while a cluster takes tasks."""
        return self._cluster is not None

    def hold(self, value: Any) -> Any:
        """A handle of a value that several tasks take."""
        return self.submit(unchanged, value)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """A handle of the result of a function."""
        work = _Work(function, arguments)
        self._there(work)
        return work

    def gather(self, handles: Sequence[Any]) -> list[Any]:
        """The results; what a task raised is raised here."""
        there, cluster = [self._there(work) for work in handles], self._cluster
        if cluster is not None and all(handle is not None for handle in there):
            try:
                results = cluster.gather(there)
            except WorkersKilled as error:
                _LOG.warning("%s; it is done in this process", error)
            except (ClusterLost, TimeoutError) as error:
                self._lose(cluster, error)
            except Exception as error:  # what the task itself raises is raised here, too
                _LOG.warning("a task failed on the Dask cluster at %s: %r; it is done here", self._address, error)
            else:
                self.elsewhere += len(handles)
                return results
        self.here += len(handles)
        return [work.value() for work in handles]

    def close(self) -> None:
        """Leave the cluster."""
        self._ended.set()
        if self._cluster is not None:
            self._cluster.close()

    def _there(self, work: _Work) -> Any:
        """The handle of some work on the cluster, which is given it where it does not have it; None without one."""
        cluster = self._cluster
        if cluster is None:
            return None
        if work.cluster is cluster:
            return work.there
        arguments = [self._there(a) if isinstance(a, _Work) else a for a in work.arguments]
        if self._cluster is not cluster:  # lost on the way
            return None
        try:
            work.there, work.cluster = cluster.submit(work.function, *arguments), cluster
        except ClusterLost as error:
            self._lose(cluster, error)
            return None
        return work.there

    def _lose(self, cluster: OnCluster, error: Exception) -> None:
        """Go on without a cluster, and look for it meanwhile."""
        reason = str(error.__cause__ or "") if isinstance(error, ClusterLost) else f"no result within {WAIT_S:.0f} s"
        _LOG.warning("the Dask cluster at %s: %s; submaps are joined in this process", self._address, reason)
        self._cluster = None
        pause_s = _RETRY_S
        if not isinstance(error, ClusterLost):  # it is there, but slow: it would be given all anew, and be slow again
            pause_s *= 2.0 ** min(self._timeouts, _MOST_DOUBLINGS)
            self._timeouts += 1
        self._look_for_it(cluster, pause_s)

    def _look_for_it(self, lost: OnCluster | None = None, pause_s: float = 0.0) -> None:
        threading.Thread(target=self._until_there, args=(lost, pause_s), name="cluster", daemon=True).start()

    def _until_there(self, lost: OnCluster | None, pause_s: float) -> None:
        """Thread: leave a lost cluster, and take the one that answers, after a pause of some s at least."""
        if lost is not None:
            with suppress(Exception):  # what is lost cannot always be left in good order
                lost.close(timeout_s=1.0)
        while not self._ended.wait(max(pause_s, _RETRY_S)):
            pause_s = _RETRY_S
            try:
                found = OnCluster(connected(self._address), wait_s=WAIT_S)
            except NotAvailable:
                continue
            except ValueError as error:
                _LOG.warning("%s; it is not used", error)
                return
            if self._ended.is_set():
                found.close()
                return
            self._cluster = found
            _LOG.warning("the Dask cluster at %s answers: it joins submaps, too", self._address)
            return
