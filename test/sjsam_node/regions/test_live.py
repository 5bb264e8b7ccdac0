# SPDX-License-Identifier: Apache-2.0
"""A live map whose tasks run on a cluster: the same bytes with it, without it, and when it goes and comes back."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

pytest.importorskip("distributed")

from dask_cluster import running_cluster
from distributed.comm.core import CommClosedError

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.loop_closure.detector import RecordPair
from sjsam_node.map_file import storage
from sjsam_node.regions import live, tasks
from sjsam_node.regions.live import LiveTasks
from sjsam_node.regions.tasks import InProcess, WorkersKilled
from sjsam_node.regions.worker_setup import Prepared, other_versions, versions
from sjsam_node.smoothing.condensing import RegionConfig
from sjsam_node.smoothing.solver import SmootherConfig
from slam_core.types import Submap

CONFIG = GlobalMapConfig(smoothing=SmootherConfig(region=RegionConfig(size=6, open=8, quiet=2)))
"""Old submaps are joined early."""


@pytest.fixture(scope="module")
def submaps() -> list[Submap]:
    rng = np.random.default_rng(1)
    return Agent(ring_world(2.0, rng, 14.0), circle(2.0, 2.2), rng).submaps()


class Counted(InProcess):
    """Runs tasks here; counts them by the name of their function."""

    def __init__(self):
        self.names = dict[str, int]()

    def submit(self, function, *arguments):
        self.names[function.__name__] = self.names.get(function.__name__, 0) + 1
        return super().submit(function, *arguments)


def packed(joined: GlobalMap) -> list[bytes]:
    one = storage.pack(joined.stored())
    return [
        repr(one.manifest).encode(),
        *(name.encode() + value.tobytes() for name, value in sorted(one.arrays.items())),
    ]


def joined_by(submaps: list[Submap], own, at: dict[int, Callable[[], None]] | None = None) -> list[bytes]:
    """The bytes of a settled map; what is told to be done before a submap is done."""
    joined = GlobalMap(CONFIG, own)
    for k, submap in enumerate(submaps):
        (at or {}).get(k, lambda: None)()
        assert joined.add(submap).accepted
    joined.settle()
    return packed(joined)


@pytest.fixture(scope="module")
def expected(submaps) -> list[bytes]:
    return joined_by(submaps, None)


def until(is_true: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not is_true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_parts_that_run_as_tasks_change_no_byte(submaps, expected):
    counted = Counted()
    assert joined_by(submaps, counted) == expected
    assert counted.names["_compared"] > len(submaps)
    assert counted.names["marginal"] >= 2


@pytest.mark.slow
def test_a_map_keeps_its_bytes_while_workers_and_scheduler_go_and_come_back(submaps, expected, monkeypatch):
    monkeypatch.setattr(live, "_RETRY_S", 0.1)
    monkeypatch.setattr(live, "WAIT_S", 60.0)  # a lost scheduler is noticed at once, and a busy machine is slow
    third, seen = len(submaps) // 3, list[tuple[int, int]]()
    with running_cluster(2) as own:
        elsewhere = LiveTasks(own.address)

        def note(do: Callable[[], None]) -> Callable[[], None]:
            return lambda: (seen.append((elsewhere.elsewhere, elsewhere.here)), do())

        def start() -> None:
            own.start()
            until(lambda: elsewhere.is_connected)

        disturbances = {third: note(own.kill_worker), 2 * third: note(own.kill), 2 * third + 3: note(start)}
        assert joined_by(submaps, elsewhere, disturbances) == expected
        seen.append((elsewhere.elsewhere, elsewhere.here))
        elsewhere.close()
    # All on the cluster until the scheduler goes, then here, then on the cluster again.
    assert [here for _, here in seen[:2]] == [0, 0]
    assert seen[0][0] < seen[1][0] == seen[2][0] < seen[3][0]
    assert 0 < seen[2][1] == seen[3][1]


@pytest.mark.slow
def test_without_workers_a_result_is_waited_for_once_and_computed_here(monkeypatch):
    monkeypatch.setattr(live, "WAIT_S", 60.0)
    with running_cluster(1) as own:
        elsewhere = LiveTasks(own.address)
        held = elsewhere.hold(3)
        assert elsewhere.gather([elsewhere.submit(pow, held, 2)]) == [9]
        own.kill_worker()
        elsewhere._cluster._wait_s = 0.5
        assert elsewhere.gather([elsewhere.submit(pow, held, 3)]) == [27]
        assert (elsewhere.elsewhere, elsewhere.here) == (1, 1)
        assert not elsewhere.is_connected
        assert elsewhere.gather([elsewhere.submit(pow, held, 4)]) == [81]
        assert (elsewhere.elsewhere, elsewhere.here) == (1, 2)
        with pytest.raises(ZeroDivisionError):
            elsewhere.gather([elsewhere.submit(divmod, held, 0)])
        elsewhere.close()


def test_a_cluster_that_is_not_there_yet_is_looked_for(monkeypatch):
    found = SimpleNamespace(close=lambda: None)
    tries = [tasks.NotAvailable("no Dask scheduler answers"), tasks.NotAvailable("no workers"), found]

    def connected(address):
        one = tries.pop(0)
        if isinstance(one, Exception):
            raise one
        return one

    monkeypatch.setattr(live, "connected", connected)
    monkeypatch.setattr(live, "_RETRY_S", 0.01)
    elsewhere = LiveTasks("tcp://somewhere:1")
    assert elsewhere.gather([elsewhere.submit(abs, -2)]) == [2]
    until(lambda: elsewhere.is_connected)
    assert not tries
    elsewhere.close()


class Failing(InProcess):
    """A cluster that gives no results, and keeps what it is asked for."""

    def __init__(self, error):
        self.error = error

    def submit(self, function, *arguments):
        return function

    def gather(self, handles):
        raise self.error

    def close(self, timeout_s=None):
        pass


def on_failing(monkeypatch, error) -> LiveTasks:
    monkeypatch.setattr(live, "connected", lambda address: None)
    monkeypatch.setattr(live, "OnCluster", lambda client, wait_s: Failing(error))
    return LiveTasks("tcp://somewhere:1")


@pytest.mark.parametrize(
    "error", [WorkersKilled("several workers ended at the same task"), MemoryError(), OSError("disk full")]
)
def test_what_fails_on_the_cluster_is_done_here_and_the_cluster_is_kept(monkeypatch, error):
    elsewhere = on_failing(monkeypatch, error)
    assert elsewhere.gather([elsewhere.submit(abs, -2)]) == [2]
    assert (elsewhere.elsewhere, elsewhere.here) == (0, 1)
    assert elsewhere.is_connected
    with pytest.raises(ZeroDivisionError):
        elsewhere.gather([elsewhere.submit(divmod, 1, 0)])
    assert LiveTasks.at("") is None


class Pauses:
    """Stands for the event that the thread waits for: keeps how long each time."""

    def __init__(self):
        self.asked = list[float]()

    def wait(self, pause_s):
        self.asked.append(pause_s)
        return False

    def is_set(self):
        return False

    def set(self):
        pass


def test_a_cluster_that_is_too_slow_again_and_again_is_left_alone_for_longer_each_time(monkeypatch):
    elsewhere = on_failing(monkeypatch, TimeoutError())
    elsewhere._ended = pauses = Pauses()
    for times in range(1, 5):
        assert elsewhere.gather([elsewhere.submit(abs, -2)]) == [2]
        until(lambda: elsewhere.is_connected)
        assert pauses.asked == [2.0, 4.0, 8.0, 16.0][:times]
    assert elsewhere.here == 4
    # The scheduler is gone: that it was slow before says nothing.
    elsewhere._cluster.error = tasks.ClusterLost("gone")
    assert elsewhere.gather([elsewhere.submit(abs, -2)]) == [2]
    until(lambda: elsewhere.is_connected)
    assert pauses.asked[4:] == [2.0]


def test_once_a_slow_cluster_has_been_left_alone_it_is_looked_for_as_often_as_any(monkeypatch):
    elsewhere = on_failing(monkeypatch, TimeoutError())
    elsewhere._ended = pauses = Pauses()
    elsewhere._timeouts = 100
    tries = [tasks.NotAvailable("no workers"), tasks.NotAvailable("no workers")]

    def connected(address):
        if tries:
            raise tries.pop()

    monkeypatch.setattr(live, "connected", connected)
    assert elsewhere.gather([elsewhere.submit(abs, -2)]) == [2]
    until(lambda: elsewhere.is_connected)
    assert pauses.asked == [512.0, 2.0, 2.0]


def test_records_are_compared_a_few_at_a_time(submaps, expected):
    class Batches(Counted):
        most = 0

        def gather(self, handles):
            self.most = max(self.most, len(handles))
            return super().gather(handles)

    few = Batches()
    joined = GlobalMap(CONFIG, few)
    for submap in submaps:
        joined.add(submap)
    comparing, few.most = joined.detector.compare, 0
    wanted = [RecordPair(0, k % len(submaps), None, 1.0, False) for k in range(1, 101)]
    found = comparing(wanted)
    assert few.most == 16
    assert len(found) == 100
    one_by_one = [comparing([one])[0] for one in wanted]
    for (several, _), (single, _) in zip(found, one_by_one, strict=True):
        assert (several is None) == (single is None)
        if several is not None:
            np.testing.assert_array_equal(several.T, single.T)


def test_other_versions_on_a_worker_are_told_by_name():
    own = versions()
    assert {"this program", "Python", "numpy"} <= own.keys()

    class Client:
        def __init__(self, **there):
            self.there = there

        def run(self, function, on_error):
            return self.there

    assert other_versions(Client(a=own, b=dict(own))) == []
    (told,) = other_versions(Client(a=own, b=own | {"numpy": "1.0"}))
    assert told == f"b has numpy 1.0, here is {own['numpy']}"
    (told,) = other_versions(Client(a=ModuleNotFoundError("No module named 'sjsam_node'")))
    assert told == "a cannot run this program: No module named 'sjsam_node'"
    with pytest.raises(tasks.NotAvailable, match="answers no more: closed"):
        other_versions(Client(a=own, b=CommClosedError("closed")))  # it died: that says nothing of its versions


def test_a_worker_of_other_versions_that_comes_later_leaves(caplog):
    left = list[object]()
    worker = SimpleNamespace(close="close", loop=SimpleNamespace(add_callback=lambda do, **given: left.append(do)))
    pickle.loads(pickle.dumps(Prepared())).setup(worker)
    assert left == []
    pickle.loads(pickle.dumps(Prepared(versions() | {"numpy": "1.0"}))).setup(worker)
    assert left == ["close"]
    assert "has numpy 1.0, here is" in caplog.text
