# SPDX-License-Identifier: Apache-2.0
"""A place that is seen again and again adds nothing to the estimate, and settling forgets nothing."""

from __future__ import annotations

import numpy as np
import pytest
from judging import ate, errors, join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.smoothing.estimator import EstimatorConfig
from sjsam_node.smoothing.regions import RegionConfig
from sjsam_node.smoothing.smoother import SmootherConfig
from slam_core.geometry import boxminus
from slam_core.types import Submap


@pytest.fixture(scope="module")
def agent() -> Agent:
    """Four laps of a small ring."""
    rng = np.random.default_rng(3)
    return Agent(ring_world(2.0, rng, 12.0), circle(2.0, 4.0), rng, "a")


@pytest.fixture(scope="module")
def submaps(agent: Agent) -> list[Submap]:
    return agent.submaps()


@pytest.fixture(scope="module")
def laps(submaps: list[Submap]) -> tuple[GlobalMap, list[int]]:
    """The map, and how many unknowns each of its updates had."""
    joined, unknowns = GlobalMap(GlobalMapConfig(redundant_share=0.3, redundant_matches=12, ties=12)), []
    for submap in submaps:
        joined.add(submap)
        unknowns.append(joined.smoother.assembled(0).problem.layout.pattern.n)
    return joined, unknowns


def test_laps_add_no_unknowns(laps: tuple[GlobalMap, list[int]]) -> None:
    joined, unknowns = laps
    lap = len(unknowns) // 4
    assert len(joined.smoother.parked) > lap
    assert max(unknowns[-lap:]) < 1.5 * max(unknowns[: 2 * lap])


def test_parked_submaps_stay_where_they_are_and_claim_no_more_than_they_know(
    laps: tuple[GlobalMap, list[int]], agent: Agent
) -> None:
    joined, _ = laps
    marginals = joined.smoother.marginals(0)
    e, nees = errors(joined, agent)
    assert ate(e) < 0.1
    assert nees.mean() / 6.0 < 2.0
    one_by_one = [marginals._hung([n]) for n in joined.graph.starts.tolist()]
    assert np.allclose(marginals._hung_alone(joined.graph.starts), one_by_one, rtol=1e-9, atol=1e-15)
    before = {r.key: joined.graph.poses[r.start].copy() for r in joined.graph.records}
    parked = joined.smoother.parked.records.tolist()
    joined.settle()
    assert len(joined.smoother.parked) == 0
    assert len(joined.smoother.assembled(0).records) == len(joined.graph.records)
    for i in parked:
        gap = boxminus(before[joined.graph.records[i].key], joined.graph.poses[joined.graph.records[i].start])
        assert np.linalg.norm(gap[:3]) < 0.05


def test_a_condensed_map_is_within_one_sigma_of_the_uncondensed_one(submaps: list[Submap]) -> None:
    """With few ties and parked submaps; before anything is settled."""
    condensed, _ = join(submaps, GlobalMap(GlobalMapConfig(redundant_share=0.3, redundant_matches=12)))
    whole = SmootherConfig(region=RegionConfig(open=10_000), estimator=EstimatorConfig(live_tolerance=1e-9))
    every, _ = join(submaps, GlobalMap(GlobalMapConfig(redundant_share=2.0, ties=1000, smoothing=whole)))
    assert len(condensed.smoother.parked)
    gaps = [boxminus(p.T, q.T) for p, q in zip(condensed.trajectory("a")[1:], every.trajectory("a")[1:], strict=True)]
    known = [p.covariance for p in condensed.trajectory("a")[1:]]
    distance = [gap @ np.linalg.solve(P, gap) / 6.0 for gap, P in zip(gaps, known, strict=True)]
    assert np.mean(distance) < 0.5
    assert np.percentile(distance, 95.0) < 1.0


def test_a_node_that_is_not_parked_has_no_reference(agent: Agent) -> None:
    joined, _ = join(agent.submaps()[:3])
    assert joined.smoother.parked.node(0) is None
