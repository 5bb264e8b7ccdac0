# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.links import Link
from sjsam_node.smoothing import submap_joining
from sjsam_node.smoothing.condensed import Active, CondensedSubmap
from sjsam_node.smoothing.condensing import RegionConfig, valid_submaps
from sjsam_node.smoothing.frozen import FrozenSubmaps
from sjsam_node.smoothing.solver import EstimatorConfig, SmootherConfig, optimized, updated
from sjsam_node.smoothing.state import EstimateState, transformed, with_exactly, with_links
from sjsam_node.smoothing.submap_joining import join_submaps, marginal
from slam_core.geometry import boxminus, boxplus, make_transform, so3_exp
from slam_core.types import Submap

ALWAYS_OPEN = RegionConfig(open=10_000)
NONE = np.empty(0, dtype=np.int64)
EAGER = RegionConfig(size=8, open=12, quiet=1)


def walk(turns: float, radius: float = 8.0, seed: int = 7) -> list[Submap]:
    rng = np.random.default_rng(seed)
    return Agent(ring_world(radius, rng, 12.0), circle(radius, turns), rng).submaps()


def global_map(region: RegionConfig) -> GlobalMap:
    """A map that is always at its optimum, with all landmarks that submaps share."""
    smoothing = SmootherConfig(region=region, estimator=EstimatorConfig(live_tolerance=1e-9))
    return GlobalMap(GlobalMapConfig(ties=1000, redundant_share=2.0, smoothing=smoothing))


@pytest.fixture(scope="module")
def submaps() -> list[Submap]:
    return walk(1.35)


@pytest.fixture(scope="module")
def open_map(submaps: list[Submap]) -> GlobalMap:
    return join(submaps, global_map(ALWAYS_OPEN))[0]


@pytest.fixture
def way() -> GlobalMap:
    """Half a round, without a closure."""
    return join(walk(0.5), global_map(ALWAYS_OPEN))[0]


def a_region(
    state: EstimateState, first: int = 3, end: int = 12, parts: Sequence[CondensedSubmap] = ()
) -> CondensedSubmap:
    records = NONE if parts else np.arange(first, end)
    work = join_submaps(state, records, 0, "joint", Active.of(state.graph, NONE), parts)
    with pytest.raises(StopIteration) as end:
        work.send(marginal(next(work)))
    region = end.value.value
    assert region is not None
    return region


def test_a_map_of_regions_is_the_map_of_its_submaps(submaps: list[Submap], open_map: GlobalMap) -> None:
    joined, closed, closures = global_map(EAGER), [], 0
    for submap in submaps:
        report = joined.add(submap)
        if report.closures:
            closures += 1
            closed.append(sum(len(r.records) for r in joined.state.problem(0).condensed))
    assert closures > 3
    assert max(closed) >= 8
    assert joined.state.result(0).cost == pytest.approx(open_map.state.result(0).cost, rel=1e-6)
    assert joined.state.result(0).redundancy == open_map.state.result(0).redundancy
    assert [(k.first, k.second) for k in joined.estimate.graph.links] == [
        (k.first, k.second) for k in open_map.estimate.graph.links
    ]
    joined.settle()
    open_map.settle()
    a, b = joined.trajectory(""), open_map.trajectory("")
    assert max(np.abs(boxminus(p.T, q.T)).max() for p, q in zip(a, b, strict=True)) < 1e-5
    assert max(np.abs(p.covariance - q.covariance).max() for p, q in zip(a, b, strict=True)) < 1e-7


def optimum(state: EstimateState, condensed: list[CondensedSubmap]) -> tuple[np.ndarray, float]:
    """Poses of what is not inside a condensed submap, and chi2, from the estimate of a state."""
    after, problem, result, _ = optimized(state, 0, SmootherConfig(), condensed, FrozenSubmaps(), coarse=False)
    return after.poses[problem.nodes], result.cost


def test_a_region_says_of_its_separator_what_its_submaps_say_wherever_it_was_linearised(way: GlobalMap) -> None:
    way.settle()
    state, rng = way.state, np.random.default_rng(1)
    poses = state.poses.copy()
    poses[1:] = boxplus(poses[1:], 2e-4 * rng.normal(size=(len(poses) - 1, 6)))
    points = state.points + 2e-4 * rng.normal(size=state.points.shape)
    region = a_region(replace(state, poses=poses, points=points))
    poses, cost = optimum(state, [region])
    outside = np.setdiff1d(np.arange(len(state.poses)), region.inner)
    assert cost == pytest.approx(state.result(0).cost, abs=1e-3)
    # What is left is Gauss-Newton's own error, residuals times curvature, along what is known to centimetres only.
    assert np.abs(boxminus(poses, state.poses[outside])).max() < 5e-5


def test_a_region_is_valid_wherever_it_is_moved_but_not_bent(way: GlobalMap) -> None:
    state, region = way.state, a_region(way.state)
    T = make_transform(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([4.0, 5.0, 6.0]))
    moved = transformed(state, 0, T)
    motion = region.apply_motion(moved.graph, moved.poses, moved.points)
    assert motion.turn < 1e-9
    assert np.allclose(motion.poses, T @ state.poses[region.inner])
    assert np.allclose(motion.points, state.points[region.inner_observations] @ T[:3, :3].T + T[:3, 3])
    poses, last = moved.poses.copy(), region.separator[-1]
    poses[last] = boxplus(poses[last], np.array([0, 0, 0, 0, 0.01, 0]))
    assert region.apply_motion(moved.graph, poses, moved.points).turn == pytest.approx(0.01, rel=1e-6)


def is_valid(region: CondensedSubmap, state: EstimateState) -> bool:
    return bool(valid_submaps(replace(state, condensed=(region,)), 0)[1])


def linked_to(state: EstimateState, observation: int, records: np.ndarray) -> EstimateState:
    """The state with a link of an observation of one of some records to the newest record."""
    graph = state.graph
    record = next(i for i in records if observation in graph.records[i].observations)
    pairs = np.array([[observation - graph.records[record].first_observation, 0]])
    return with_links(state, [Link(record, len(graph.records) - 1, pairs, np.eye(4), np.eye(6), True)])


def test_what_links_the_inside_of_a_region_expands_it_and_what_links_its_separator_does_not(way: GlobalMap) -> None:
    state, region = way.state, a_region(way.state)
    assert is_valid(region, state)
    for observations, is_open in ((region.separator_observations, False), (region.inner_observations, True)):
        assert is_valid(region, linked_to(state, int(observations[0]), region.records)) != is_open


@pytest.fixture
def always_worth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two regions are joined even if that saves little."""
    monkeypatch.setattr(submap_joining, "_WORTH", np.inf)


@pytest.mark.usefixtures("always_worth")
def test_a_region_of_regions_says_what_its_submaps_say(way: GlobalMap) -> None:
    way.settle()
    state = way.state
    whole, parts = a_region(state, 3, 21), [a_region(state, 3, 12), a_region(state, 12, 21)]
    nested = a_region(state, parts=parts)
    for name in ("records", "separator", "inner", "inner_observations", "landmarks", "redundancy", "uses"):
        assert np.array_equal(getattr(nested, name), getattr(whole, name)), name
    scale = np.abs(whole.information).max()
    assert np.allclose(nested.information, whole.information, rtol=0.0, atol=1e-6 * scale)
    steps = [np.linalg.solve(c.information, c.gradient) for c in (nested, whole)]
    assert np.allclose(*steps, rtol=0.0, atol=1e-7)
    assert nested.constant == pytest.approx(whole.constant, rel=1e-6)
    surer = np.linalg.eigvalsh(nested.node_covariances - whole.node_covariances)
    assert surer.min() > -1e-9  # never, where it is inside a part


@pytest.mark.usefixtures("always_worth")
def test_a_link_to_the_inside_of_a_region_of_regions_leaves_the_other_parts_closed(way: GlobalMap) -> None:
    state = way.state
    parts = [a_region(state, 3, 12), a_region(state, 12, 21)]
    state = linked_to(state, int(parts[0].inner_observations[0]), parts[0].records)
    nested = a_region(way.state, parts=parts)
    assert valid_submaps(replace(state, condensed=(nested,)), 0)[1] == [parts[1]]


def test_a_landmark_of_the_separator_that_is_let_go_is_estimated_by_the_region_alone(way: GlobalMap) -> None:
    region = a_region(way.state)
    was_older = way.state.graph.landmark_of[region.landmarks] < region.landmarks
    inside = set(region.records.tolist())
    links = [k for k in way.state.graph.links if (k.first in inside) == (k.second in inside)]
    state = replace(with_exactly(way.state, links), condensed=(region,))
    assert is_valid(region, state)
    alone = region.landmarks[was_older & (state.graph.landmark_of[region.landmarks] == region.landmarks)]
    config = replace(way.config.smoothing, region=RegionConfig(relinearize=1.0))
    state = updated(state, len(state.graph.records) - 1, [], [], config)
    assert state.condensed == (region,)
    found = state.points[alone]
    way.estimate.accept(state)
    way.settle()
    assert len(alone) > 3
    assert np.abs(found - way.state.points[alone]).max() < 1e-3


def test_a_large_region_may_turn_further_before_it_is_opened(way: GlobalMap) -> None:
    config, region = RegionConfig(size=8, relinearize=0.002), a_region(way.state)
    assert config.largest_turn(replace(region, records=np.arange(4))) == pytest.approx(0.002)
    assert config.largest_turn(replace(region, records=np.arange(32))) == pytest.approx(0.004)


def test_a_region_behind_an_open_way_is_kept_in_the_frame_of_its_open_end(way: GlobalMap) -> None:
    graph, region = way.estimate.graph, a_region(way.state, 0, 12)
    assert (region.root, region.reference) == (graph.records[0].start, graph.records[11].end)
    root, T, covariance = region.node(int(region.inner[0]))
    assert root == region.root
    assert np.abs(T - way.state.poses[region.inner[0]]).max() < 1e-12  # the map's own frame is that of its first node
    way.settle()
    exact = way.state.marginals(0).ends(0)[6:, 6:]
    assert np.abs(covariance - exact).max() < 0.3 * np.abs(exact).max()


def test_a_closure_touches_only_the_regions_that_it_affects() -> None:
    joined = global_map(RegionConfig(size=8, open=16, quiet=1))
    untouched = []
    for submap in walk(2.2):
        before = {id(r) for r in joined.state.condensed}
        if joined.add(submap).closures and len(joined.estimate.graph.records) > 60:
            untouched.append(sum(id(r) in before for r in joined.state.condensed) / max(len(before), 1))
    assert len(untouched) > 5
    assert np.mean(untouched) > 0.5


def test_saving_forgets_regions_so_that_a_loaded_map_goes_on_alike(submaps: list[Submap], tmp_path: object) -> None:
    joined, _ = join(submaps[:-6], global_map(EAGER))
    joined.save(str(tmp_path))
    assert not joined.state.condensed
    loaded = GlobalMap.load(str(tmp_path), joined.config)
    for submap in submaps[-6:]:
        joined.add(submap)
        loaded.add(submap)
    assert np.array_equal(joined.state.poses, loaded.state.poses)
