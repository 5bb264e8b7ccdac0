# SPDX-License-Identifier: Apache-2.0
"""The session of a map, without ROS: its three modes, what is answered at once, and what an empty map does not do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node.agents import in_order
from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.session.autosave import Autosave
from sjsam_node.session.map_session import MapSession, Mode, Outcome
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.types import PoseEstimate, PositionReading, Submap


@pytest.fixture
def submaps(rng: np.random.Generator) -> list[Submap]:
    return Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.25), rng, "a").submaps()


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def saved(folder: Path, submaps: list[Submap]) -> Path:
    """The folder of a map of some submaps."""
    with MapSession(GlobalMapConfig()) as session:
        for submap in submaps:
            session.add(submap)
        session.finish().result()
        session.save(folder).result()
    return folder


class HeldJoiner:
    """``GlobalMap.add`` that joins only when it may."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.may_go_on, self.is_held = threading.Event(), threading.Event()
        add = GlobalMap.add

        def held(joined: GlobalMap, submap: Submap, readings: Sequence[PositionReading] = ()) -> JoinReport:
            self.is_held.set()
            assert self.may_go_on.wait(60.0)
            return add(joined, submap, readings)

        monkeypatch.setattr(GlobalMap, "add", held)


# -- what waits --------------------------------------------------------------------------------------------------------


def test_what_is_asked_for_goes_before_submaps_that_wait_and_their_number_is_told(
    submaps: list[Submap], monkeypatch: pytest.MonkeyPatch
) -> None:
    held = HeldJoiner(monkeypatch)
    with MapSession(GlobalMapConfig()) as session:
        outcomes = [session.add(submap) for submap in submaps[:3]]
        finished, asked = session.finish(), session.read(len)
        assert session.waiting == session.waiting_at_most == 3
        held.may_go_on.set()
        finished.result()
        assert all(outcome.done() for outcome in outcomes)
        assert asked.result() in (0, 1), "as soon as the submap at hand is joined"
        assert (session.waiting, session.waiting_at_most, len(session.snapshot)) == (0, 3, 3)


def test_a_session_that_is_left_leaves_what_waits_undone(
    submaps: list[Submap], monkeypatch: pytest.MonkeyPatch
) -> None:
    held = HeldJoiner(monkeypatch)
    with MapSession(GlobalMapConfig()) as session:
        outcomes = [session.add(submap) for submap in submaps[:2]]
        assert held.is_held.wait(5.0)
        threading.Timer(0.1, held.may_go_on.set).start()
    assert [outcome.done() for outcome in outcomes] == [True, False]


def test_the_thread_ends_with_a_session_that_nobody_closes() -> None:
    before = threading.active_count()
    session = MapSession(GlobalMapConfig())
    session.read(len).result()
    assert threading.active_count() == before + 1
    del session
    deadline = time.monotonic() + 10.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_what_one_submap_raises_reaches_its_future_and_the_next_is_joined(
    submaps: list[Submap], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    add = GlobalMap.add
    monkeypatch.setattr(GlobalMap, "add", lambda joined, s, _: add(joined, s) if s.index else 1 / 0)
    session = MapSession(GlobalMapConfig(), autosave=Autosave(tmp_path / "copy", 10.0))
    futures = [session.add(submap) for submap in submaps]
    session.close()
    assert isinstance(futures[0].exception(), ZeroDivisionError)
    found = [future.result() for future in futures[1:]]
    assert all(outcome is not None and outcome.report is not None and outcome.report.accepted for outcome in found)
    assert len(session.snapshot.poses) == len(submaps) == len(session.snapshot) + 1
    assert session.waiting == 0
    assert len(GlobalMap.load(tmp_path / "copy.ended").snapshot()) == len(submaps) - 1


@pytest.mark.parametrize("busy", ["add", "rebuilt_in_time_order"])
def test_a_reset_forgets_what_the_thread_is_at(
    submaps: list[Submap], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, busy: str
) -> None:
    """A submap, or the settled map that was asked for before, does not come back."""
    begun, may_go_on, work = threading.Event(), threading.Event(), getattr(GlobalMap, busy)

    def held(joined: GlobalMap, *arguments: Submap) -> object:
        if len(joined.snapshot()) == 2:
            begun.set()
            assert may_go_on.wait(60.0)
        return work(joined, *arguments)

    monkeypatch.setattr(GlobalMap, busy, held)
    with MapSession(GlobalMapConfig(), autosave=Autosave(tmp_path / "copy", 10.0)) as session:
        outcomes = [session.add(submap) for submap in submaps[: 4 if busy == "add" else 2]]
        at_hand, shown = outcomes[2] if busy == "add" else session.finish(), []
        at_hand.add_done_callback(lambda _: shown.append(len(session.snapshot)))
        assert begun.wait(60.0)
        session.reset()
        assert len(session.snapshot) == 0
        with pytest.raises(ValueError, match="empty map"):
            session.mark(np.zeros(3))
        may_go_on.set()
        assert session.read(len).result() == len(session.snapshot) == 0
        assert shown == [0], "what is at hand is not shown any more"
        assert [outcome.result() for outcome in outcomes[2:]] == [None] * len(outcomes[2:])
        assert session.save_copy() is None
        after = session.add(submaps[0]).result()
        assert after is not None
        assert after.end is not None


# -- modes -------------------------------------------------------------------------------------------------------------


def test_a_mark_that_an_empty_map_refuses_makes_no_copy(tmp_path: Path) -> None:
    session = MapSession(GlobalMapConfig(), autosave=Autosave(tmp_path / "copy", 10.0))
    with pytest.raises(ValueError, match="empty map"):
        session.mark(np.zeros(3))
    assert session.save_copy() is None
    session.close()
    assert list(tmp_path.iterdir()) == []


def every_submap(session: MapSession, submaps: list[Submap]) -> list[Outcome]:
    outcomes = [session.add(submap) for submap in submaps]
    session.finish().result()
    return [outcome for future in outcomes if (outcome := future.result()) is not None]


def test_an_extended_map_keeps_its_frame_and_its_agents_go_on_in_new_sessions(
    submaps: list[Submap], rng: np.random.Generator, tmp_path: Path
) -> None:
    old, again = saved(tmp_path / "old", submaps), Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.1), rng, "b")
    with MapSession(GlobalMapConfig()) as session:
        session.load(old, len).result()
        assert (session.mode, session.known) == (Mode.EXTEND, len(submaps))
        assert (session.next_session, MapSession(GlobalMapConfig()).next_session) == (1, -1)
        every_submap(session, again.submaps())
        assert session.snapshot.keys[: len(submaps)] == [(s.agent, s.session, s.index) for s in submaps]
        np.testing.assert_array_equal(session.snapshot.poses[0], np.eye(4))
        assert set(session.read(lambda shown: shown.trajectory(session.known)).result()) == {"b"}


def test_a_map_to_locate_in_stays_as_it_is_to_the_byte(rng: np.random.Generator, tmp_path: Path) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.0), rng, "a")
    old, visitor = saved(tmp_path / "old", agent.submaps()), Agent(agent.world, agent.path[10:40], rng, "visitor")
    with MapSession(GlobalMapConfig(), Mode.LOCALISE) as session:
        assert session.load(old, len).result() == session.known
        outcomes = every_submap(session, visitor.submaps())
        assert sum(outcome.closures for outcome in outcomes) >= len(outcomes) // 2
        for submap, outcome in zip(visitor.submaps(), outcomes, strict=True):
            stamps = [pose.stamp_ns for pose in submap.path]
            assert [pose.stamp_ns for pose in outcome.path] == (stamps if outcome.end else [])
        session.reset()
        session.save(tmp_path / "new").result()
    assert files(tmp_path / "new") == files(old)


def test_an_empty_map_cannot_be_gone_on_in(tmp_path: Path) -> None:
    GlobalMap().save(tmp_path / "empty")
    with MapSession(GlobalMapConfig()) as session, pytest.raises(ValueError, match=r"the map in .*empty is empty"):
        session.load(tmp_path / "empty", len).result()


def test_a_told_pose_counts_for_the_next_submap(rng: np.random.Generator, tmp_path: Path) -> None:
    old = saved(tmp_path / "old", Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "a").submaps())
    stranger = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.1), rng, "b").submaps()[0]
    told = PoseEstimate(0, np.eye(4), 1e-4 * np.eye(6))
    with MapSession(GlobalMapConfig(), Mode.LOCALISE) as session:
        session.load(old, len).result()
        assert session.add(stranger).result().end is None
        session.set_pose("b", told)
        follows = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "b").submaps()[1]
        np.testing.assert_allclose(session.add(follows).result().end.T, follows.end_pose)


# -- the map at the end ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("agents", ["a", "ab"])
@pytest.mark.parametrize("saved_on_the_way", [False, True])
def test_a_finished_map_is_that_of_an_offline_run_to_the_byte_whoever_came_first(
    rng: np.random.Generator, tmp_path: Path, saved_on_the_way: bool, agents: str
) -> None:
    """Two agents in one ring, or one: the second one's submaps come first, and a mark is set."""
    world, path = ring_world(4.0, rng, 12.0), circle(4.0, 1.0)
    A = Agent(world, path[:61], rng, "a").submaps()
    B = Agent(world, path[45:], rng, "b", stamp_ns=2_000_000_000).submaps() if "b" in agents else []
    with MapSession(GlobalMapConfig()) as offline:
        every_submap(offline, in_order(A + B))
        offline.save(tmp_path / "offline", is_last=True).result()
    with MapSession(GlobalMapConfig()) as online:
        for k, submap in enumerate(B + A):
            outcome = online.add(submap)
            if saved_on_the_way and k == 3:
                outcome.result()
                online.save(tmp_path / "early").result()
        online.finish().result()
        online.save(tmp_path / "online").result()
        online.mark(np.zeros(3))
        online.finish().result()
        assert len(online.snapshot.marks.marks) == 1
    assert GlobalMap.load(tmp_path / "online").snapshot().keys[0][0] == "a"
    assert files(tmp_path / "offline") == files(tmp_path / "online")


def test_a_mark_set_while_the_map_is_rebuilt_is_on_the_same_place(
    submaps: list[Submap], monkeypatch: pytest.MonkeyPatch
) -> None:
    rebuilt = GlobalMap.rebuilt_in_time_order
    with MapSession(GlobalMapConfig()) as session:

        def marking(joined: GlobalMap) -> GlobalMap:
            done = rebuilt(joined)
            session.mark(session.snapshot.poses[2, :3, 3])
            return done

        monkeypatch.setattr(GlobalMap, "rebuilt_in_time_order", marking)
        every_submap(session, submaps[::-1])
        marked, poses = session.snapshot.mark_positions(), session.snapshot.poses
        ends: Callable[[MapSnapshot], list[int]] = lambda shown: [s.index for s in shown.submaps]  # noqa: E731
        assert ends(session.snapshot) == list(range(len(submaps)))
        assert np.linalg.norm(poses[:, :3, 3] - marked[0], axis=1).min() < 1e-9
