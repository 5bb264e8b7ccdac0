from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.joiner import Joiner, JoinerConfig
from sjsam_node.map_graph import Link, MapGraph
from sjsam_node.regions import Region, RegionConfig
from sjsam_node.regions import join as join_region
from slam_core.geometry import boxminus, boxplus, make_transform, so3_exp
from slam_core.types import Submap

ALWAYS_OPEN = RegionConfig(open=10_000)
EAGER = RegionConfig(size=8, open=12, quiet=1)


def walk(turns: float, radius: float = 8.0, seed: int = 7) -> list[Submap]:
    rng = np.random.default_rng(seed)
    return Agent(ring_world(radius, rng, 12.0), circle(radius, turns), rng).submaps()


def global_map(region: RegionConfig) -> GlobalMap:
    return GlobalMap(GlobalMapConfig(joining=JoinerConfig(incremental_from=10, front_work=1e9, region=region)))


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


def a_region(joiner: Joiner) -> Region:
    region = join_region(joiner.graph, np.arange(3, 12), 0, joiner.estimator.local_maps)
    assert region is not None
    return region


def test_a_map_of_regions_is_the_map_of_its_submaps(submaps: list[Submap], open_map: GlobalMap) -> None:
    joined, closed, closures = global_map(EAGER), [], 0
    for submap in submaps:
        report = joined.add(submap)
        if report.closures:
            closures += 1
            closed.append(sum(len(r.records) for r in joined.joiner.opened(0).regions))
    assert closures > 3
    assert max(closed) >= 8
    assert joined.joiner.cost(0) == pytest.approx(open_map.joiner.cost(0), rel=1e-6)
    assert joined.joiner.redundancy(0) == open_map.joiner.redundancy(0)
    assert [(k.first, k.second) for k in joined.graph.links] == [(k.first, k.second) for k in open_map.graph.links]
    a, b = joined.trajectory(""), open_map.trajectory("")
    assert max(np.abs(boxminus(p.T, q.T)).max() for p, q in zip(a, b, strict=True)) < 1e-5
    assert max(np.abs(p.covariance - q.covariance).max() for p, q in zip(a, b, strict=True)) < 1e-7


def optimum(joiner: Joiner, regions: list[Region]) -> tuple[np.ndarray, float]:
    """Poses of what is not inside a region, and chi2, from the joiner's estimate."""
    checkpoint = joiner.checkpoint()
    assembled, result = joiner.estimator.optimize(joiner.graph, 0, regions=regions)
    poses = joiner.graph.poses[assembled.nodes]
    joiner.restore(checkpoint)
    return poses, result.cost


def test_a_region_says_of_its_rim_what_its_submaps_say_wherever_it_was_linearised(way: GlobalMap) -> None:
    joiner = way.joiner
    way.settle()
    rng = np.random.default_rng(1)
    settled = joiner.checkpoint()
    joiner.graph.poses[1:] = boxplus(joiner.graph.poses[1:], 2e-4 * rng.normal(size=(len(joiner.graph.poses) - 1, 6)))
    joiner.graph.points += 2e-4 * rng.normal(size=joiner.graph.points.shape)
    region = a_region(joiner)
    joiner.restore(settled)
    poses, cost = optimum(joiner, [region])
    outside = np.setdiff1d(np.arange(len(joiner.graph.poses)), region.inner)
    assert cost == pytest.approx(joiner.cost(0), abs=1e-3)
    # What is left is Gauss-Newton's own error, residuals times curvature, along what is known to centimetres only.
    assert np.abs(boxminus(poses, joiner.graph.poses[outside])).max() < 5e-5


def test_a_region_holds_wherever_it_is_carried_but_not_bent(way: GlobalMap) -> None:
    joiner, graph = way.joiner, way.graph
    region = a_region(joiner)
    before = joiner.checkpoint()
    inner, points = graph.poses[region.inner].copy(), graph.points[region.inner_observations].copy()
    T = make_transform(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([4.0, 5.0, 6.0]))
    graph.move(0, T)
    assert region.carry(graph) < 1e-9
    assert np.allclose(graph.poses[region.inner], T @ inner)
    assert np.allclose(graph.points[region.inner_observations], points @ T[:3, :3].T + T[:3, 3])
    graph.poses[region.rim[-1]] = boxplus(graph.poses[region.rim[-1]], np.array([0, 0, 0, 0, 0.01, 0]))
    assert region.carry(graph) == pytest.approx(0.01, rel=1e-6)
    joiner.restore(before)


def holds(region: Region, graph: MapGraph) -> bool:
    joiner = Joiner(graph, 3)
    joiner.regions.closed = [region]
    return bool(joiner.regions.fitting(graph, 0, np.empty(0, dtype=np.int64)))


def test_what_links_the_inside_of_a_region_opens_it_and_what_links_its_rim_does_not(way: GlobalMap) -> None:
    joiner, graph = way.joiner, way.graph
    region = a_region(way.joiner)
    other = len(graph.records) - 1
    for observations, is_open in ((region.rim_observations, False), (region.inner_observations, True)):
        observation = int(observations[0])
        record = next(i for i in region.records if observation in graph.records[i].observations)
        pairs = np.array([[observation - graph.records[record].first_observation, 0]])
        before = joiner.checkpoint()
        assert holds(region, graph)
        graph.add_link(Link(record, other, pairs, np.eye(4), np.eye(6), True))
        assert holds(region, graph) != is_open
        joiner.restore(before)


def test_a_landmark_of_the_rim_that_is_let_go_is_estimated_by_the_region_alone(way: GlobalMap) -> None:
    joiner, graph = way.joiner, way.graph
    region = a_region(joiner)
    was_older = graph.landmark_of[region.landmarks] < region.landmarks
    inside = set(region.records.tolist())
    graph.replace_links([k for k in graph.links if (k.first in inside) == (k.second in inside)])
    assert holds(region, graph)
    alone = region.landmarks[was_older & (graph.landmark_of[region.landmarks] == region.landmarks)]
    joiner.config = replace(joiner.config, region=RegionConfig(bend=1.0))
    joiner.regions.closed = [region]
    joiner.batch(len(graph.records) - 1)
    assert joiner.regions.closed == [region]
    found = graph.points[alone]
    joiner.batch(len(graph.records) - 1, whole=True)
    assert len(alone) > 3
    assert np.abs(found - graph.points[alone]).max() < 1e-3


def test_a_closure_touches_only_the_regions_that_it_affects() -> None:
    joined = global_map(RegionConfig(size=8, open=16, quiet=1))
    untouched = []
    for submap in walk(2.2):
        before = {id(r) for r in joined.joiner.regions.closed}
        if joined.add(submap).closures and len(joined.graph.records) > 60:
            untouched.append(sum(id(r) in before for r in joined.joiner.regions.closed) / max(len(before), 1))
    assert len(untouched) > 5
    assert np.mean(untouched) > 0.5


def test_saving_forgets_regions_so_that_a_loaded_map_goes_on_alike(submaps: list[Submap], tmp_path: object) -> None:
    joined, _ = join(submaps[:-6], global_map(EAGER))
    joined.save(str(tmp_path))
    assert not joined.joiner.regions.closed
    loaded = GlobalMap.load(str(tmp_path), joined.config)
    for submap in submaps[-6:]:
        joined.add(submap)
        loaded.add(submap)
    assert np.array_equal(joined.graph.poses, loaded.graph.poses)
