# SPDX-License-Identifier: Apache-2.0
"""A place that is seen again and again adds nothing to the estimate, and settling forgets nothing."""

from __future__ import annotations

import numpy as np
import pytest
from judging import ate, errors, join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.smoothing.condensing import RegionConfig
from sjsam_node.smoothing.solver import EstimatorConfig, SmootherConfig
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
        unknowns.append(joined.state.problem(0).problem.layout.pattern.n)
    return joined, unknowns


def test_laps_add_no_unknowns(laps: tuple[GlobalMap, list[int]]) -> None:
    joined, unknowns = laps
    lap = len(unknowns) // 4
    assert len(joined.state.frozen) > lap
    assert max(unknowns[-lap:]) < 1.5 * max(unknowns[: 2 * lap])


def test_frozen_submaps_stay_where_they_are_and_claim_no_more_than_they_know(
    laps: tuple[GlobalMap, list[int]], agent: Agent
) -> None:
    joined, _ = laps
    marginals = joined.state.marginals(0)
    e, nees = errors(joined, agent)
    assert ate(e) < 0.1
    assert nees.mean() / 6.0 < 2.0
    one_by_one = [marginals._dependent_covariance([n]) for n in joined.estimate.graph.starts.tolist()]
    assert np.allclose(
        marginals._dependent_covariances(joined.estimate.graph.starts), one_by_one, rtol=1e-9, atol=1e-15
    )
    before = {r.key: joined.state.poses[r.start].copy() for r in joined.estimate.graph.records}
    frozen = joined.state.frozen.records.tolist()
    joined.settle()
    assert len(joined.state.frozen) == 0
    assert len(joined.state.problem(0).records) == len(joined.estimate.graph.records)
    for i in frozen:
        gap = boxminus(
            before[joined.estimate.graph.records[i].key], joined.state.poses[joined.estimate.graph.records[i].start]
        )
        assert np.linalg.norm(gap[:3]) < 0.05


def test_a_condensed_map_is_within_one_sigma_of_the_uncondensed_one(submaps: list[Submap]) -> None:
    """With few ties and frozen submaps; before anything is settled."""
    condensed, _ = join(submaps, GlobalMap(GlobalMapConfig(redundant_share=0.3, redundant_matches=12)))
    whole = SmootherConfig(region=RegionConfig(open=10_000), estimator=EstimatorConfig(live_tolerance=1e-9))
    every, _ = join(submaps, GlobalMap(GlobalMapConfig(redundant_share=2.0, ties=1000, smoothing=whole)))
    assert len(condensed.state.frozen)
    gaps = [boxminus(p.T, q.T) for p, q in zip(condensed.trajectory("a")[1:], every.trajectory("a")[1:], strict=True)]
    known = [p.covariance for p in condensed.trajectory("a")[1:]]
    distance = [gap @ np.linalg.solve(P, gap) / 6.0 for gap, P in zip(gaps, known, strict=True)]
    assert np.mean(distance) < 0.5
    assert np.percentile(distance, 95.0) < 1.0


def test_a_node_that_is_not_frozen_has_no_reference(agent: Agent) -> None:
    joined, _ = join(agent.submaps()[:3])
    assert joined.state.frozen.node(0) is None
