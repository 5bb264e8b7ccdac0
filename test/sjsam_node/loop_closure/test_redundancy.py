# SPDX-License-Identifier: Apache-2.0
"""Comparisons that can tell nothing new are left out, and only those."""

from __future__ import annotations

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap
from sjsam_node.graph.links import Link
from sjsam_node.loop_closure.redundancy import RedundancyCheck
from sjsam_node.loop_closure.verification import MIN_NEAR_INLIERS, ClosureConfig
from sjsam_node.smoothing.state import with_exactly


@pytest.fixture
def joined(rng: np.random.Generator) -> GlobalMap:
    """Three laps of a small ring."""
    return join(Agent(ring_world(2.5, rng, 12.0), circle(2.5, 3.0), rng, "a").submaps())[0]


def check(joined: GlobalMap) -> RedundancyCheck:
    config = ClosureConfig()
    return RedundancyCheck(joined.state, MIN_NEAR_INLIERS, config.association.descriptor_threshold, 0.15)


def closure(joined: GlobalMap) -> Link:
    return max((k for k in joined.estimate.graph.links if k.is_closure), key=lambda k: len(k.pairs))


def test_submaps_whose_landmarks_are_one_already_are_not_compared_again(joined: GlobalMap) -> None:
    link, known = closure(joined), check(joined)
    assert known.is_all_known(link.first, link.second)
    assert not known.is_known(link.second)


def test_a_landmark_that_may_be_another_ones_calls_for_a_comparison(joined: GlobalMap) -> None:
    link = closure(joined)
    joined.estimate.accept(with_exactly(joined.state, []))
    for other in ({5}, set(range(len(link.pairs)))):
        known, left = check(joined), [k for k in range(len(link.pairs)) if k not in other]
        known.note(Link(link.first, link.second, link.pairs[left], link.T, link.covariance, True))
        assert known.is_known(link.second)
        assert not known.is_all_known(link.first, link.second)
    known.note(link)
    assert known.is_all_known(link.first, link.second)


def test_links_found_tie_to_all_that_see_the_same_landmarks(joined: GlobalMap) -> None:
    """A new submap linked to one of the first lap is known to those of the second."""
    graph = joined.estimate.graph
    link = closure(joined)
    ends = (link.first, link.second)
    third = max(
        (i for i in range(len(graph.records)) if i not in ends),
        key=lambda i: np.isin(
            graph.landmark_of[graph.records[i].observations], graph.landmark_of[graph.records[link.first].observations]
        ).sum(),
    )
    others = [k for k in graph.links if link.second not in (k.first, k.second)]
    joined.estimate.accept(with_exactly(joined.state, others))
    known = check(joined)
    assert not known.is_all_known(third, link.second)
    known.note(link)
    before = len(np.intersect1d(known._seen(third), known._seen(link.second)))
    assert before >= known.enough


def test_many_laps_need_few_links(joined: GlobalMap) -> None:
    """Measured 1.0 closures a submap; one to each of the old ones around it would be about ten."""
    closures = sum(k.is_closure for k in joined.estimate.graph.links)
    assert 0.3 * len(joined.estimate.graph.records) < closures < 3.0 * len(joined.estimate.graph.records)
