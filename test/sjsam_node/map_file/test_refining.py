# SPDX-License-Identifier: Apache-2.0
"""Further landmarks of a submap that is in the map: nothing moves, and what was undecided is compared anew."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import ALREADY_JOINED, GlobalMap
from sjsam_node.map_file import storage
from sjsam_node.map_file.refining import has_more
from slam_core.types import Submap


def part(submap: Submap, count: int) -> Submap:
    """The submap with its first landmarks."""
    m = 6 + 3 * count
    return replace(
        submap, landmarks=submap.landmarks[:count], covariance=submap.covariance[:m, :m],
        landmark_ids=submap.landmark_ids[:count], sightings=submap.sightings[:count],
        descriptors=submap.descriptors[:count],
    )  # fmt: skip


@pytest.fixture
def agent(rng: np.random.Generator) -> Agent:
    return Agent(ring_world(4.0, rng, 12.0), circle(4.0, 1.25), rng, "a")


def test_further_landmarks_come_in_and_nothing_moves(agent: Agent) -> None:
    whole = agent.submaps()
    joined = GlobalMap()
    for submap in whole:
        joined.add(part(submap, len(submap.landmarks) // 2))
    before, records = joined.state.poses.copy(), len(joined.estimate.graph.records)
    links = [(k.ends, len(k.pairs)) for k in joined.estimate.graph.links if not k.is_closure]
    report = joined.add(whole[1])
    assert report.accepted
    assert report.is_refined
    assert report.new_landmarks == len(whole[1].landmarks) - len(whole[1].landmarks) // 2
    assert len(joined.estimate.graph.records) == records
    assert len(joined.estimate.graph.records[1].submap.landmarks) == len(whole[1].landmarks)
    assert [(k.ends, len(k.pairs)) for k in joined.estimate.graph.links if not k.is_closure] == links
    assert np.abs(joined.state.poses[:, :3, 3] - before[:, :3, 3]).max() < 0.05
    assert joined.add(whole[1]).reason == ALREADY_JOINED
    assert joined.add(part(whole[1], 5)).reason == ALREADY_JOINED


def test_a_closure_that_too_little_spoke_for_is_found_with_them(agent: Agent) -> None:
    whole = agent.submaps()
    joined = GlobalMap()
    for submap in whole:
        joined.add(part(submap, 6))
    few = sum(k.is_closure for k in joined.estimate.graph.links)
    for submap in whole:
        assert joined.add(submap).is_refined
    assert sum(k.is_closure for k in joined.estimate.graph.links) > few


def test_settled_it_is_the_map_of_whole_submaps(agent: Agent) -> None:
    """Whenever the landmarks came: a post that asked ends up with what one that had all has."""
    whole = agent.submaps()
    late, straight = GlobalMap(), GlobalMap()
    for submap in whole:
        straight.add(submap)
        late.add(part(submap, len(submap.landmarks) // 2))
    for submap in reversed(whole):
        late.add(submap)
    straight.settle()
    late = late.rebuilt_in_time_order()
    np.testing.assert_array_equal(late.state.poses, straight.state.poses)


def test_put_away_and_taken_up_again_it_settles_to_the_same_map(agent: Agent, tmp_path: Path) -> None:
    whole = agent.submaps()
    unbroken = GlobalMap()
    for submap in whole:
        unbroken.add(part(submap, len(submap.landmarks) // 2))
    unbroken.add(whole[1])
    storage.write(tmp_path / "map", unbroken.stored())
    again = GlobalMap.load(tmp_path / "map")
    np.testing.assert_array_equal(again.rebuilt_in_time_order().state.poses,
                                  unbroken.rebuilt_in_time_order().state.poses)  # fmt: skip


def test_a_map_of_before_says_nothing_of_its_order_and_loads(agent: Agent, tmp_path: Path) -> None:
    joined = GlobalMap()
    joined.add(agent.submaps()[0])
    storage.write(tmp_path / "map", joined.stored())
    assert "is_out_of_order" not in json.loads((tmp_path / "map" / "manifest.json").read_text())
    assert not storage.read(tmp_path / "map").is_out_of_order


def test_another_submap_of_the_same_name_is_none_with_more(agent: Agent) -> None:
    submap = agent.submaps()[0]
    less = part(submap, 5)
    assert has_more(submap, less)
    assert not has_more(less, submap)
    assert not has_more(submap, submap)
    assert not has_more(submap, replace(less, landmark_ids=less.landmark_ids + 1))
    assert not has_more(submap, replace(less, end_stamp_ns=less.end_stamp_ns + 1))
