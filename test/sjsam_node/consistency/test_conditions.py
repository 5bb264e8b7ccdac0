# SPDX-License-Identifier: Apache-2.0
"""Closures that later ones contradict: a false one that was believed goes, a false one that comes late is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from judging import ate, errors, join
from submap_world import Agent, Sensor, World, circle, path_through, ring_world, room

from sjsam_node.consistency.conditions import Verdict
from sjsam_node.consistency.pairwise import PairwiseConsistency
from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.links import Link, Prior, Status
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.loop_closure.association import match
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.loop_closure.verification import ClosureConfig
from sjsam_node.smoothing.solver import updated
from slam_core.geometry import boxminus, invert_transform
from slam_core.types import Submap

BACK_AND_FORTH = [
    (-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (13.0, 0.0), (13.0, -1.0), (15.0, -1.0), (15.0, 1.0), (13.0, 0.5),
    (1.0, 0.5), (-1.0, 0.5), (-1.0, -1.0), (1.0, -1.0), (1.0, 0.0),
]  # fmt: skip


def look_alike_rooms(rng: np.random.Generator) -> Agent:
    """A walk through two rooms that look alike to the last descriptor, 14 m apart, and back to the first."""
    first = room((0.0, 0.0), (4.0, 4.0), 90, rng)
    corridor = np.stack([rng.uniform(2, 12, 120), rng.choice([-1.2, 1.2], 120), rng.uniform(-1, 1.5, 120)], axis=1)
    world = World.random(np.concatenate([first, first + np.array([14.0, 0.0, 0.0]), corridor]), rng)
    world.descriptors[90:180] = world.descriptors[:90]
    return Agent(world, path_through(BACK_AND_FORTH), rng, "a", Sensor(max_range=3.5))


def false_link(joined: GlobalMap, agent: Agent) -> Link:
    """The closure that looks best of those between the two rooms, 14 m off."""
    graph, best = joined.estimate.graph, None
    for first in (i for i in range(len(graph.records)) if agent.true_start(i)[0, 3] < 2.0):
        for second in (i for i in range(len(graph.records)) if agent.true_start(i)[0, 3] > 12.0):
            shift = agent.true_start(second).copy()
            shift[0, 3] -= 14.0
            T = invert_transform(agent.true_start(first)) @ shift
            prior = Prior(T, 1e-2 * np.eye(6))
            found = match(
                at_start(graph.records[first]),
                at_start(graph.records[second]),
                prior,
                joined.config.closure.association,
            )
            if best is None or len(found.pairs) > len(best.pairs):
                best = Link(first, second, found.pairs, found.T, found.covariance, is_closure=True)
    assert best is not None
    return best


@pytest.fixture
def agent(rng: np.random.Generator) -> Agent:
    return look_alike_rooms(rng)


def test_a_false_closure_that_was_believed_is_taken_back_when_true_ones_contradict_it(agent: Agent) -> None:
    submaps = agent.submaps()
    arrival = next(k for k in range(len(submaps)) if agent.true_start(k)[0, 3] > 14.0)
    honest, _ = join(submaps)
    joined, _ = join(submaps[: arrival + 1])
    false = false_link(joined, agent)
    assert len(false.pairs) >= 10
    joined.estimate.accept(updated(joined.state, arrival, [false], [], joined.config.smoothing))
    assert ate(errors(joined, agent)[0]) > 1.0
    gone = None
    for k, submap in enumerate(submaps[arrival + 1 :]):
        joined.add(submap)
        if gone is None and not any(link.ends == false.ends for link in joined.estimate.graph.links):
            gone = k
    assert gone is not None  # as it is contradicted, not when the map settles
    joined.settle()
    assert not any(link.ends == false.ends for link in joined.estimate.graph.links)
    assert joined.counters.counts["closures let go"] >= 1
    assert ate(errors(joined, agent)[0]) < 1.5 * ate(errors(honest, agent)[0])


def test_a_false_closure_on_trial_is_refused_and_leaves_no_trace(agent: Agent) -> None:
    submaps = agent.submaps()
    arrival = next(k for k in range(len(submaps)) if agent.true_start(k)[0, 3] > 14.0)
    joined, _ = join(submaps[: arrival + 1])
    joined.settle()
    before, links = joined.state.poses, len(joined.estimate.graph.links)
    verdict = joined.closures.join_closures([false_link(joined, agent)], arrival)
    assert not verdict.accepted
    assert len(joined.estimate.graph.links) == links
    joined.settle()
    assert np.abs(boxminus(joined.state.poses[-1], before[-1])).max() < 1e-6


def test_a_false_closure_that_odometry_does_not_rule_out_is_refused_by_the_map(agent: Agent) -> None:
    """With so much drift to expect, odometry lets it pass: what refuses it is that chi2 of the map rises."""
    submaps = agent.submaps()
    joined, _ = join(submaps, GlobalMap(GlobalMapConfig(closure=ClosureConfig(drift=0.05, drift_angle=0.05))))
    state = joined.state
    false = false_link(joined, agent)
    assert not joined.closures.pairwise.against_odometry(state.graph, [false]).any()
    verdict = joined.closures.join_closures([false], len(submaps) - 1)
    assert not verdict.accepted
    assert joined.state.graph is state.graph
    assert np.abs(boxminus(joined.state.poses[-1], state.poses[-1])).max() < 1e-5


def test_agents_joined_by_rooms_that_look_alike_are_told_apart_by_what_they_see_later(agent: Agent) -> None:
    """Nothing but what comes later can tell two such rooms apart."""
    path, sensor = agent.path, agent.sensor
    arrival = next(k for k, T in enumerate(path) if T[0, 3] > 12.9)
    first = Agent(agent.world, path[:25], agent.rng, "a", sensor)
    second = Agent(agent.world, path[arrival:], agent.rng, "b", sensor, stamp_ns=10**11)
    origin = invert_transform(first.path[0])

    def error(joined: GlobalMap) -> float:
        return float(np.abs(boxminus(origin @ second.path[0], joined.trajectory("b")[0].T)).max())

    joined, _ = join(first.submaps())
    B = second.submaps()
    alone = next(k for k in range(len(B)) if second.true_start(k)[0, 3] < 13.0 and k > 3)
    join(B[:alone], joined)
    assert joined.components == 1
    assert error(joined) > 10.0
    join(B[alone:], joined)
    assert joined.counters.counts["closures let go"] > 0
    assert joined.components == 1
    assert error(joined) < 0.3


def test_closures_found_when_the_map_settles_are_judged_in_groups_consistent_ones_by_themselves(
    agent: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a false one takes few true ones with it."""
    joined, _ = join(agent.submaps()[:3], GlobalMap(GlobalMapConfig(joined_at_once=2)))
    link, offered = joined.estimate.graph.links[0], []

    def join_closures(found: list[Link], newest: int) -> Verdict:
        offered.append([k.status for k in found])
        return Verdict()

    missed = [link.with_status(Status.INCONSISTENT), *[link.with_status(Status.CONSISTENT)] * 3]
    monkeypatch.setattr(joined.detector, "missed", lambda *_: [missed.pop(0) for _ in range(len(missed))])
    monkeypatch.setattr(joined.closures, "join_closures", join_closures)
    joined.settle()
    assert offered == [[Status.CONSISTENT] * 2, [Status.CONSISTENT], [Status.INCONSISTENT]]


def few_landmarks(seed: int, sure: float) -> tuple[Agent, list[Submap]]:
    """Two rounds among 20 landmarks, a submap sees about six; variances are ``sure`` times too small."""
    rng = np.random.default_rng(seed)
    world = ring_world(3.0, rng, 20.0 / (6.0 * np.pi) + 1e-9)
    agent = Agent(world, circle(3.0, 2.0), rng, "a", Sensor(half_fov=1.5))
    return agent, [replace(s, covariance=s.covariance / sure) for s in agent.submaps()]


def chain_ate(agent: Agent, submaps: list[Submap]) -> float:
    """Error of the ends of the submaps as the filter chains them, m."""
    T, e = agent.path[0], []
    for k, submap in enumerate(submaps):
        T = T @ submap.end_pose
        e.append(np.linalg.norm(T[:3, 3] - agent.true_start(k + 1)[:3, 3]))
    return float(np.sqrt(np.mean(np.square(e))))


@pytest.mark.parametrize("seed", [1, 2])
def test_joining_submaps_that_contradict_each_other_is_not_worse_than_their_chain(seed: int, tmp_path: Path) -> None:
    agent, submaps = few_landmarks(seed, 100.0)
    joined, reports = join(submaps)
    assert reports[-1].is_strained
    joined.settle()
    e, nees = errors(joined, agent)
    joined.save(tmp_path / "map")
    assert ate(e) < 1.05 * chain_ate(agent, submaps)
    assert nees.mean() / 6.0 < 2.0, "and says so"
    assert f"{len(submaps)} of {len(submaps)} are chained" in joined.snapshot().overconfidence
    assert "slam calibrate refine" in joined.snapshot().overconfidence, "and says what to do"
    loaded = GlobalMap.load(tmp_path / "map")
    assert loaded.snapshot().overconfidence == joined.snapshot().overconfidence
    assert np.array_equal(errors(loaded, agent)[1], nees)


def test_honest_submaps_with_few_landmarks_are_joined_and_kept() -> None:
    agent, submaps = few_landmarks(1, 1.0)
    joined, _ = join(submaps)
    joined.settle()
    assert not joined.snapshot().overconfidence
    assert ate(errors(joined, agent)[0]) < 0.5 * chain_ate(agent, submaps)


def test_a_closure_that_waits_takes_nothing_with_it_that_a_new_one_does_not_contradict(monkeypatch) -> None:
    def link(first: int, second: int) -> Link:
        return Link(first, second, np.zeros((5, 2), int), np.eye(4), np.eye(6), is_closure=True)

    found, same, false = link(0, 9), link(1, 10), link(3, 20)
    rival, true = link(1, 8), link(4, 21)
    contradicts = {(found.ends, rival.ends), (same.ends, rival.ends), (false.ends, true.ends)}
    monkeypatch.setattr(
        PairwiseConsistency,
        "excluded",
        lambda _, graph, one, others: np.array([(one.ends, k.ends) in contradicts for k in others]),
    )
    pairwise, graph = PairwiseConsistency(), MapGraph()
    group, rivals = pairwise.with_rivals(graph, [found, same, false], [rival, true], {found.ends})
    assert group == [found, same]
    assert rivals == [rival]
    assert pairwise.with_rivals(graph, [found, false], [], {found.ends}) == ([found, false], [])
