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
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing import region as region_module
from sjsam_node.smoothing.estimator import EstimatorConfig
from sjsam_node.smoothing.region import Active, Region
from sjsam_node.smoothing.region import join as join_region
from sjsam_node.smoothing.regions import RegionConfig
from sjsam_node.smoothing.smoother import Smoother, SmootherConfig
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


def a_region(smoother: Smoother, first: int = 3, end: int = 12, parts: Sequence[Region] = ()) -> Region:
    records = NONE if parts else np.arange(first, end)
    active = Active.of(smoother.graph, NONE)
    region = join_region(smoother.graph, records, 0, smoother.estimator.local_maps, active, parts)
    assert region is not None
    return region


def test_a_map_of_regions_is_the_map_of_its_submaps(submaps: list[Submap], open_map: GlobalMap) -> None:
    joined, closed, closures = global_map(EAGER), [], 0
    for submap in submaps:
        report = joined.add(submap)
        if report.closures:
            closures += 1
            closed.append(sum(len(r.records) for r in joined.smoother.assembled(0).regions))
    assert closures > 3
    assert max(closed) >= 8
    assert joined.smoother.result(0).cost == pytest.approx(open_map.smoother.result(0).cost, rel=1e-6)
    assert joined.smoother.result(0).redundancy == open_map.smoother.result(0).redundancy
    assert [(k.first, k.second) for k in joined.graph.links] == [(k.first, k.second) for k in open_map.graph.links]
    joined.settle()
    open_map.settle()
    a, b = joined.trajectory(""), open_map.trajectory("")
    assert max(np.abs(boxminus(p.T, q.T)).max() for p, q in zip(a, b, strict=True)) < 1e-5
    assert max(np.abs(p.covariance - q.covariance).max() for p, q in zip(a, b, strict=True)) < 1e-7


def optimum(smoother: Smoother, regions: list[Region]) -> tuple[np.ndarray, float]:
    """Poses of what is not inside a region, and chi2, from the smoother's estimate."""
    checkpoint = smoother.checkpoint()
    assembled, result = smoother.estimator.optimize(smoother.graph, 0, regions=regions)
    poses = smoother.graph.poses[assembled.nodes]
    smoother.restore(checkpoint)
    return poses, result.cost


def test_a_region_says_of_its_separator_what_its_submaps_say_wherever_it_was_linearised(way: GlobalMap) -> None:
    smoother = way.smoother
    way.settle()
    rng = np.random.default_rng(1)
    settled = smoother.checkpoint()
    smoother.graph.poses[1:] = boxplus(
        smoother.graph.poses[1:], 2e-4 * rng.normal(size=(len(smoother.graph.poses) - 1, 6))
    )
    smoother.graph.points += 2e-4 * rng.normal(size=smoother.graph.points.shape)
    region = a_region(smoother)
    smoother.restore(settled)
    poses, cost = optimum(smoother, [region])
    outside = np.setdiff1d(np.arange(len(smoother.graph.poses)), region.inner)
    assert cost == pytest.approx(smoother.result(0).cost, abs=1e-3)
    # What is left is Gauss-Newton's own error, residuals times curvature, along what is known to centimetres only.
    assert np.abs(boxminus(poses, smoother.graph.poses[outside])).max() < 5e-5


def test_a_region_holds_wherever_it_is_carried_but_not_bent(way: GlobalMap) -> None:
    smoother, graph = way.smoother, way.graph
    region = a_region(smoother)
    before = smoother.checkpoint()
    inner, points = graph.poses[region.inner].copy(), graph.points[region.inner_observations].copy()
    T = make_transform(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([4.0, 5.0, 6.0]))
    graph.move(0, T)
    assert region.carry(graph) < 1e-9
    assert np.allclose(graph.poses[region.inner], T @ inner)
    assert np.allclose(graph.points[region.inner_observations], points @ T[:3, :3].T + T[:3, 3])
    graph.poses[region.separator[-1]] = boxplus(graph.poses[region.separator[-1]], np.array([0, 0, 0, 0, 0.01, 0]))
    assert region.carry(graph) == pytest.approx(0.01, rel=1e-6)
    smoother.restore(before)


def holds(region: Region, graph: MapGraph) -> bool:
    smoother = Smoother(graph)
    smoother.regions.closed = [region]
    return bool(smoother.regions.fitting(graph, 0, NONE))


def test_what_links_the_inside_of_a_region_opens_it_and_what_links_its_separator_does_not(way: GlobalMap) -> None:
    smoother, graph = way.smoother, way.graph
    region = a_region(way.smoother)
    other = len(graph.records) - 1
    for observations, is_open in ((region.separator_observations, False), (region.inner_observations, True)):
        observation = int(observations[0])
        record = next(i for i in region.records if observation in graph.records[i].observations)
        pairs = np.array([[observation - graph.records[record].first_observation, 0]])
        before = smoother.checkpoint()
        assert holds(region, graph)
        graph.add_link(Link(record, other, pairs, np.eye(4), np.eye(6), True))
        assert holds(region, graph) != is_open
        smoother.restore(before)


@pytest.fixture
def always_worth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two regions are joined even if that saves little."""
    monkeypatch.setattr(region_module, "_WORTH", np.inf)


@pytest.mark.usefixtures("always_worth")
def test_a_region_of_regions_says_what_its_submaps_say(way: GlobalMap) -> None:
    way.settle()
    smoother = way.smoother
    whole, parts = a_region(smoother, 3, 21), [a_region(smoother, 3, 12), a_region(smoother, 12, 21)]
    nested = a_region(smoother, parts=parts)
    for name in ("records", "separator", "inner", "inner_observations", "landmarks", "redundancy", "uses"):
        assert np.array_equal(getattr(nested, name), getattr(whole, name)), name
    scale = np.abs(whole.information).max()
    assert np.allclose(nested.information, whole.information, rtol=0.0, atol=1e-6 * scale)
    assert np.allclose(np.linalg.solve(nested.information, nested.pull), np.linalg.solve(whole.information, whole.pull),
                       rtol=0.0, atol=1e-7)  # fmt: skip
    assert nested.constant == pytest.approx(whole.constant, rel=1e-6)
    surer = np.linalg.eigvalsh(nested.node_covariances - whole.node_covariances)
    assert surer.min() > -1e-9  # never, where it is inside a part


@pytest.mark.usefixtures("always_worth")
def test_a_link_to_the_inside_of_a_region_of_regions_leaves_the_other_parts_closed(way: GlobalMap) -> None:
    smoother, graph = way.smoother, way.graph
    parts = [a_region(smoother, 3, 12), a_region(smoother, 12, 21)]
    smoother.regions.closed = [a_region(smoother, parts=parts)]
    observation = int(parts[0].inner_observations[0])
    record = next(i for i in parts[0].records if observation in graph.records[i].observations)
    pairs = np.array([[observation - graph.records[record].first_observation, 0]])
    graph.add_link(Link(record, len(graph.records) - 1, pairs, np.eye(4), np.eye(6), True))
    assert smoother.regions.fitting(graph, 0, NONE) == [parts[1]]


def test_a_landmark_of_the_separator_that_is_let_go_is_estimated_by_the_region_alone(way: GlobalMap) -> None:
    smoother, graph = way.smoother, way.graph
    region = a_region(smoother)
    was_older = graph.landmark_of[region.landmarks] < region.landmarks
    inside = set(region.records.tolist())
    graph.replace_links([k for k in graph.links if (k.first in inside) == (k.second in inside)])
    assert holds(region, graph)
    alone = region.landmarks[was_older & (graph.landmark_of[region.landmarks] == region.landmarks)]
    smoother.config = replace(smoother.config, region=RegionConfig(relinearize=1.0))
    smoother.regions.closed = [region]
    smoother.update(len(graph.records) - 1)
    assert smoother.regions.closed == [region]
    found = graph.points[alone]
    way.settle()
    assert len(alone) > 3
    assert np.abs(found - graph.points[alone]).max() < 1e-3


def test_a_large_region_may_turn_further_before_it_is_opened(way: GlobalMap) -> None:
    config, region = RegionConfig(size=8, relinearize=0.002), a_region(way.smoother)
    assert config.largest_turn(replace(region, records=np.arange(4))) == pytest.approx(0.002)
    assert config.largest_turn(replace(region, records=np.arange(32))) == pytest.approx(0.004)


def test_a_region_behind_an_open_way_is_kept_in_the_frame_of_its_open_end(way: GlobalMap) -> None:
    graph, region = way.graph, a_region(way.smoother, 0, 12)
    assert (region.root, region.reference) == (graph.records[0].start, graph.records[11].end)
    root, T, covariance = region.node(int(region.inner[0]))
    assert root == region.root
    assert np.abs(T - graph.poses[region.inner[0]]).max() < 1e-12  # the map's own frame is that of its first node
    way.settle()
    exact = way.smoother.marginals(0).ends(0)[6:, 6:]
    assert np.abs(covariance - exact).max() < 0.3 * np.abs(exact).max()


def test_a_closure_touches_only_the_regions_that_it_affects() -> None:
    joined = global_map(RegionConfig(size=8, open=16, quiet=1))
    untouched = []
    for submap in walk(2.2):
        before = {id(r) for r in joined.smoother.regions.closed}
        if joined.add(submap).closures and len(joined.graph.records) > 60:
            untouched.append(sum(id(r) in before for r in joined.smoother.regions.closed) / max(len(before), 1))
    assert len(untouched) > 5
    assert np.mean(untouched) > 0.5


def test_saving_forgets_regions_so_that_a_loaded_map_goes_on_alike(submaps: list[Submap], tmp_path: object) -> None:
    joined, _ = join(submaps[:-6], global_map(EAGER))
    joined.save(str(tmp_path))
    assert not joined.smoother.regions.closed
    loaded = GlobalMap.load(str(tmp_path), joined.config)
    for submap in submaps[-6:]:
        joined.add(submap)
        loaded.add(submap)
    assert np.array_equal(joined.graph.poses, loaded.graph.poses)
