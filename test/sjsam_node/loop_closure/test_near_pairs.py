# SPDX-License-Identifier: Apache-2.0
"""What was missed because a place was seen before the map knew where: found when the map knows, in any order."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.agents import in_order
from sjsam_node.global_map import GlobalMap
from sjsam_node.graph.links import Prior, Status
from sjsam_node.loop_closure.association import match
from sjsam_node.loop_closure.near_pairs import Compared
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.smoothing.state import with_exactly
from slam_core.geometry import boxminus, boxplus, invert_transform
from slam_core.types import Submap

STEP = np.array([0.05, -0.03, 0.02, 0.01, 0.0, -0.01])


@pytest.fixture
def agent(rng: np.random.Generator) -> Agent:
    return Agent(ring_world(3.0, rng, 12.0), circle(3.0, 1.5), rng, "a")


def believed_pairs(joined: GlobalMap) -> set[tuple[object, ...]]:
    records = joined.estimate.graph.records
    return {
        tuple(sorted((records[k.first].key, records[k.second].key)))
        for k in joined.estimate.graph.links
        if k.is_closure
    }


def same_landmarks(joined: GlobalMap) -> set[frozenset[tuple[object, ...]]]:
    """Every two observations that the map takes for one landmark."""
    graph = joined.estimate.graph
    seen: dict[int, list[tuple[object, ...]]] = {}
    for record in graph.records:
        for k, landmark in enumerate(graph.landmark_of[record.observations].tolist()):
            seen.setdefault(landmark, []).append((*record.key, k))
    return {frozenset(pair) for members in seen.values() for pair in combinations(members, 2)}


def test_pairs_are_compared_once_and_again_when_they_have_moved(agent: Agent) -> None:
    joined, _ = join(agent.submaps())
    graph, near = joined.estimate.graph, joined.detector.near
    missed = {(k.first, k.second) for k in graph.links if k.is_closure}
    state = with_exactly(joined.state, [k for k in graph.links if not k.is_closure])
    near.compared = Compared()
    due = near.due(state, joined.agents.chained)
    assert len(missed & set(due)) > 10
    assert not any((k.first, k.second) in due for k in state.graph.links)
    for first, second in due:
        near.note(state, second, first)
    assert not near.due(state, joined.agents.chained)
    first, second = due[0]
    poses, moved = state.poses.copy(), graph.records[second].start
    poses[moved] = boxplus(poses[moved], STEP)
    assert (first, second) in near.due(replace(state, poses=poses), joined.agents.chained)


def test_compared_pairs_are_kept_like_a_dictionary_of_them(rng: np.random.Generator) -> None:
    compared, plain = Compared(), {}
    for pair in rng.integers(0, 9, (60, 2)):
        first, second = sorted(pair.tolist())
        seen = rng.normal(size=(1, 3))
        compared.note(np.array([[first, second]]), seen)
        plain[first, second] = seen[0]
    every = np.array([(i, k) for i in range(9) for k in range(i, 9)])
    for forgotten in (set[int](), {3, 5}):
        compared.forget(forgotten)
        expected = [plain.get((i, k), np.full(3, np.inf)) for i, k in every if not {i, k} & forgotten]
        kept = ~np.isin(every, list(forgotten)).any(axis=1)
        assert np.array_equal(compared.where(every[kept]), expected)
        assert np.isinf(compared.where(every[~kept])).all()
    again = Compared.of(compared.pairs[::-1], compared.seen[::-1])
    assert np.array_equal(again.codes, compared.codes)
    assert np.array_equal(again.seen, compared.seen)


def test_parts_without_a_tie_have_no_near_pairs(rng: np.random.Generator) -> None:
    a = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "a")
    b = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "b")
    joined, _ = join(a.submaps() + b.submaps())
    agents = [record.submap.agent for record in joined.estimate.graph.records]
    assert all(
        agents[i] == agents[k] for i, k in joined.detector.near.due(joined.state, np.empty((0, 2), dtype=np.int64))
    )


def test_a_prior_too_sure_of_itself_does_not_hide_matches(agent: Agent) -> None:
    joined, _ = join(agent.submaps())
    link = max((k for k in joined.estimate.graph.links if k.is_closure), key=lambda k: len(k.pairs))
    first, second = (at_start(joined.estimate.graph.records[i]) for i in (link.first, link.second))
    T = invert_transform(agent.true_start(link.first)) @ agent.true_start(link.second)
    wrong = Prior(boxplus(T, STEP), np.diag([0.01**2] * 3 + [0.003**2] * 3))
    config = joined.config.closure.association
    possible = len(match(first, second, Prior(T, wrong.covariance), config).pairs)
    assert len(match(first, second, wrong, config).pairs) < 0.8 * possible
    found, status = joined.detector.verifier.verify(first, second, wrong, 0.0, link.first, link.second)
    assert status is Status.CONSISTENT
    assert found is not None
    assert len(found.pairs) >= 0.9 * possible
    assert np.abs(boxminus(found.T, T)[:3]).max() < 0.5 * np.abs(STEP).max()


@pytest.fixture(scope="module")
def two_agents() -> list[tuple[list[Submap], list[Submap]]]:
    """Submaps of two agents in each of four worlds, who meet twice."""
    met = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        world, path = ring_world(4.0, rng, 12.0), circle(4.0, 1.0)
        a = Agent(world, path[:61], rng, "a").submaps()
        met.append((a, Agent(world, path[45:], rng, "b", stamp_ns=5_000_000_000).submaps()))
    return met


def test_what_is_believed_hardly_depends_on_who_comes_first(
    two_agents: list[tuple[list[Submap], list[Submap]]],
) -> None:
    """Of the observations that are one landmark; measured 0.994."""
    shares = []
    for a, b in two_agents:
        one, other = join(a + b)[0], join(b + a)[0]
        one.settle()
        other.settle()
        same = same_landmarks(one), same_landmarks(other)
        shares.append(len(same[0] & same[1]) / len(same[0] | same[1]))
    assert np.mean(shares) > 0.97


def test_the_central_map_does_not_depend_on_who_comes_first(
    two_agents: list[tuple[list[Submap], list[Submap]]],
) -> None:
    for a, b in two_agents:
        one, other = join(in_order(a + b))[0], join([*b[:3], *a[::-1], *b[3:]])[0]
        mark = other.marks.add(other.state.poses, other.state.poses[other.estimate.graph.records[9].start][:3, 3])
        assert one.rebuilt_in_time_order() is one
        central = other.rebuilt_in_time_order()
        assert same_landmarks(one) == same_landmarks(central)
        for name in "ab":
            gap = [boxminus(p.T, q.T) for p, q in zip(one.trajectory(name), central.trajectory(name), strict=True)]
            assert np.abs(gap).max() < 1e-9
        marked = [
            [r.key for r in m.estimate.graph.records if m.marks.marks[0].node == r.start] for m in (other, central)
        ]
        assert marked[0] == marked[1]
        assert len(marked[0]) == 1
        assert np.array_equal(central.marks.marks[0].point, mark.point)
