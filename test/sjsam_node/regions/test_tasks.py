# SPDX-License-Identifier: Apache-2.0
"""Tasks on Dask's workers: the same bytes as in process, also when a worker dies, and clear lines where none can be."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from random_joining import MODELS, random_problem
from threadpoolctl import threadpool_info

from sjsam_node.joint_problem.problem import flatten
from sjsam_node.regions.tasks import ClusterLost, InProcess, NotAvailable, OnCluster, cluster, connected
from sjsam_node.regions.tree import RegionTree


def solved(tasks, between=lambda: None):
    maps, state = random_problem(MODELS["tangent"], np.random.default_rng(3), maps=40, landmarks=60)
    tree = RegionTree(flatten(maps), state, np.array([0]), MODELS["tangent"], tasks, leaf_maps=2, task_maps=6)
    tree.eliminate(state)
    between()
    return [tree.step(), *tree.covariances()]


@pytest.fixture(scope="module")
def client():
    distributed = pytest.importorskip("distributed")
    here = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**here) as local, distributed.Client(local) as client:
        yield client


@pytest.mark.slow
def test_what_a_task_raises_is_raised_where_its_result_is_asked_for(client):
    tasks = OnCluster(client)
    with pytest.raises(ValueError, match="too small"):
        tasks.gather([tasks.submit(int, "too small")])


@pytest.mark.slow
def test_workers_give_the_same_bytes_also_when_one_is_killed_half_way(client):
    expected = [part.tobytes() for part in solved(InProcess())]
    assert [part.tobytes() for part in solved(OnCluster(client))] == expected
    killed = []

    def kill_one():
        """Kill a worker that holds factors, so that these have to be made again."""
        deadline, holders = time.monotonic() + 60.0, list[str]()
        while not holders:
            assert time.monotonic() < deadline, f"no worker holds a factor: {client.has_what()}"
            time.sleep(0.05)
            holders = [w for w, keys in client.has_what().items() if any("eliminate_piece" in str(k) for k in keys)]
        killed.append(client.run(os.getpid, workers=holders[:1])[holders[0]])
        os.kill(killed[0], signal.SIGKILL)

    assert [part.tobytes() for part in solved(OnCluster(client), kill_one)] == expected
    assert killed


def blas_threads(tasks) -> set[int]:
    """Numbers of threads of BLAS on a worker, which has loaded it for its first task."""
    tasks.gather([tasks.submit(np.linalg.inv, np.eye(2))])
    (found,) = tasks.gather([tasks.submit(threadpool_info)])
    return {one["num_threads"] for one in found if one["user_api"] == "blas"}


@pytest.mark.slow
def test_a_scheduler_that_is_started_again_gets_all_work_once_more_and_its_workers_are_set_up(monkeypatch):
    pytest.importorskip("distributed")
    from dask_cluster import running_cluster

    expected, told = [part.tobytes() for part in solved(InProcess())], []
    with running_cluster() as own, cluster(own.address) as tasks:
        assert blas_threads(tasks) == {1}
        tell = tasks.channel(told.append)

        def restart():
            own.kill()
            own.start(is_awaited=False)

        assert [part.tobytes() for part in solved(tasks, restart)] == expected
        assert blas_threads(tasks) == {1}  # of a worker that came later
        tasks.gather([tasks.submit(tell, "from the new worker")])
        until(lambda: told == ["from the new worker"])
        own.kill()
        monkeypatch.setattr("sjsam_node.regions.tasks._RETURN_S", 0.0)
        monkeypatch.setattr("sjsam_node.regions.tasks._PATIENCE_S", 1)
        with pytest.raises(ClusterLost, match="start it again"):
            tasks.gather([tasks.submit(int)])
        with pytest.raises(ClusterLost, match="start it again"):
            tasks.submit(int)


class OfOneProcess:
    """A client whose cluster is lost when told to; counts what it is given."""

    def __init__(self):
        self.given, self.is_lost = list[str](), False

    def submit(self, function, *arguments, pure):
        self._check()
        self.given.append(arguments[0])
        return arguments[0]

    def gather(self, futures):
        self._check()
        return list(futures)

    def close(self, timeout):
        pass

    def _check(self):
        if self.is_lost:
            from distributed.comm.core import CommClosedError

            raise CommClosedError("closed")


def test_a_cluster_that_is_there_again_is_given_at_once_all_that_is_still_asked_for():
    pytest.importorskip("distributed")
    first, second = OfOneProcess(), OfOneProcess()
    tasks = OnCluster(first, lambda: second)
    handles = [tasks.submit(str, name) for name in "abcd"]
    assert tasks.gather(handles[:1]) == ["a"]
    del handles[3]  # nobody asks for it any more
    first.is_lost = True
    assert tasks.gather(handles[1:2]) == ["b"]
    assert second.given == ["b", "c"]
    assert tasks.gather(handles) == ["a", "b", "c"]


def test_the_cluster_drops_what_nobody_can_ask_for_and_makes_it_again_where_it_is_needed():
    pytest.importorskip("distributed")

    class Future:
        """What a client gives, which drops its result when the last reference ends."""

        def __init__(self, function, arguments):
            self.value = function(*(a.value if isinstance(a, Future) else a for a in arguments))

    class Client(OfOneProcess):
        def submit(self, function, *arguments, pure):
            self._check()
            self.given.append(function)
            future = Future(function, arguments)
            self.alive.add(future)
            return future

        def gather(self, futures):
            self._check()
            return [future.value for future in futures]

    first, second = Client(), Client()
    first.alive, second.alive = weakref.WeakSet(), weakref.WeakSet()
    tasks = OnCluster(first, lambda: second)
    base = tasks.submit(int, "7")
    above = tasks.submit(str, base)
    assert len(first.alive) == 2
    del base
    assert len(first.alive) == 1
    first.is_lost = True
    assert tasks.gather([above]) == ["7"]
    assert second.given == [int, str]


def test_a_cluster_that_does_not_come_back_is_waited_for_once():
    pytest.importorskip("distributed")
    client, asked = OfOneProcess(), []

    def again():
        asked.append(1)
        raise ValueError("no scheduler answers")

    tasks = OnCluster(client, again)
    handles = [tasks.submit(str, name) for name in "abc"]
    client.is_lost = True
    for handle in handles:
        with pytest.raises(ClusterLost):
            tasks.gather([handle])
    assert asked == [1]


def until(is_true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30.0
    while not is_true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_a_scheduler_that_has_ended_is_told_where_a_task_is_given():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as local:
        client = distributed.Client(local)
        tasks = OnCluster(client)
        assert tasks.gather([tasks.hold(1)]) == [1]
        client.close()
        for call in (partial(tasks.hold, 1), partial(tasks.submit, int)):
            with pytest.raises(ValueError, match="cluster was lost"):
                call()


def test_a_lost_cluster_and_a_task_that_kills_workers_are_told():
    distributed = pytest.importorskip("distributed")

    class Lost:
        def __init__(self, error):
            self.error = error

        def gather(self, handles):
            raise self.error

        def submit(self, *arguments, pure):
            raise self.error

    killed = distributed.KilledWorker("task", SimpleNamespace(address="tcp://host:1"), 3)
    for error in (distributed.comm.CommClosedError("closed"), distributed.client.ClosedClientError("closed")):
        tasks = OnCluster(Lost(error))
        for call in (partial(tasks.gather, []), partial(tasks.hold, 1), partial(tasks.submit, int)):
            with pytest.raises(ValueError, match="cluster was lost"):
                call()
    with pytest.raises(ValueError, match="want of memory"):
        OnCluster(Lost(killed)).gather([])


def test_results_are_waited_for_one_after_the_other_and_fetched_within_the_same_time(monkeypatch):
    distributed = pytest.importorskip("distributed")
    waits, fetches = list[tuple[int, float]](), list[float]()

    def wait(left, timeout, return_when):
        waits.append((len(left), timeout))
        assert return_when == "FIRST_COMPLETED"
        return SimpleNamespace(not_done=left[1:])

    class Client(OfOneProcess):
        def as_current(self):
            return nullcontext()

        def gather(self, futures, asynchronous):
            assert asynchronous
            return list(futures)

        def sync(self, function, futures, callback_timeout):
            fetches.append(callback_timeout)
            if self.is_lost:  # its worker died before the fetch
                raise TimeoutError
            return function(futures)

    monkeypatch.setattr(distributed, "wait", wait)
    client = Client()
    tasks = OnCluster(client, wait_s=7.0)
    handles = [tasks.submit(str, name) for name in "abc"]
    assert tasks.gather(handles) == ["a", "b", "c"]
    assert waits == [(3, 7.0), (2, 7.0), (1, 7.0)]
    client.is_lost = True
    with pytest.raises(TimeoutError):
        tasks.gather(handles)
    assert fetches == [7.0, 7.0]


@pytest.mark.slow
def test_a_result_that_is_lost_before_it_is_fetched_is_not_waited_for_for_ever(monkeypatch):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as local:
        client = distributed.Client(local, set_as_default=False)
        tasks = OnCluster(client, wait_s=0.1)
        monkeypatch.setattr(distributed, "wait", lambda *_: SimpleNamespace(not_done=()))  # it was there a moment ago
        handle = tasks.submit(time.sleep, 3.0)
        with pytest.raises(TimeoutError):
            tasks.gather([handle])
        client.close()


def test_tries_to_reach_a_scheduler_that_is_not_there_leave_no_thread_behind(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("sjsam_node.regions.tasks._PATIENCE_S", 0.2)

    def left() -> list[str]:
        return [one.name for one in threading.enumerate() if one.name == "IO loop"]

    before = left()
    with socket.socket() as mute:  # its queue takes connections, and nobody speaks
        mute.bind(("127.0.0.1", 0))
        for _ in range(2):
            for listens in (False, True):
                if listens:
                    mute.listen()
                with pytest.raises(NotAvailable, match="no Dask scheduler answers"):
                    connected(f"tcp://127.0.0.1:{mute.getsockname()[1]}")
    assert left() == before


class Reached:
    """A client of a cluster whose workers cannot be set up."""

    def __init__(self, error):
        self.error, self.is_closed = error, False

    def get_versions(self, check):
        pass

    def scheduler_info(self):
        return {"workers": {"a": {}}}

    def run(self, function, on_error):
        return {"a": function()}

    def register_plugin(self, plugin):
        raise self.error

    def close(self):
        self.is_closed = True


def test_workers_that_cannot_be_set_up_now_are_tried_again_later(monkeypatch):
    distributed = pytest.importorskip("distributed")

    async def greet(address):
        pass

    monkeypatch.setattr("sjsam_node.regions.tasks._greet", greet)
    for error in (RuntimeError("no space for compiled code"), OSError("closed")):
        client = Reached(error)
        monkeypatch.setattr(distributed, "Client", lambda *_, client=client, **__: client)
        with pytest.raises(NotAvailable, match=str(error)):
            connected("tcp://somewhere:1")
        assert client.is_closed


def test_without_distributed_everything_runs_in_process_unless_workers_are_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with cluster() as tasks:
        assert isinstance(tasks, InProcess)
    with pytest.raises(ModuleNotFoundError), cluster(workers=2):
        pass
    with pytest.raises(ValueError, match="not both"), cluster("tcp://host:8786", 2):
        pass
