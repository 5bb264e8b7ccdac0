# SPDX-License-Identifier: Apache-2.0
"""Finished maps become one: tied by places, of the same bytes in any order and with any number of workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node import storage
from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.merging.across import AcrossMaps
from sjsam_node.merging.merge import merge
from sjsam_node.merging.union import NamedMap, united
from sjsam_node.regions.tasks import InProcess, cluster

RADIUS = 4.0


def day(number: int, name: str = "", turns: tuple[float, float] = (0.0, 0.7), world_seed: int = 1) -> NamedMap:
    """The map of a walk along a part of the ring, of its own session."""
    world = ring_world(RADIUS, np.random.default_rng(world_seed), 26.0)
    path = circle(RADIUS, turns[1])[round(len(circle(RADIUS, turns[0])) - 1) :]
    agent = Agent(world, path, np.random.default_rng(100 + number), name, stamp_ns=10**9 * (1000 * number + 1))
    built = GlobalMap()
    for submap in agent.submaps():
        assert built.add(replace(submap, session=number)).accepted
    built.settle()
    return NamedMap(f"day {number}", built.stored())


@pytest.fixture(scope="module")
def days():
    return [day(1), day(2, turns=(0.3, 1.0)), day(3, "bert", (0.1, 0.6))]


def packed(merged) -> tuple[dict, dict]:
    one = storage.pack(merged.map.stored())
    return one.manifest, {name: np.array(value) for name, value in one.arrays.items()}


def assert_same_bytes(first, second):
    assert first[0] == second[0]
    assert first[1].keys() == second[1].keys()
    for name, value in first[1].items():
        assert value.tobytes() == second[1][name].tobytes(), name


def test_maps_of_days_and_agents_become_one_map_at_its_optimum(days):
    merged = merge(days, GlobalMapConfig(), InProcess())
    assert merged.parts == (("day 1", "day 2", "day 3"),)
    assert merged.closures >= 3
    assert not merged.notes
    snapshot = merged.map.snapshot()
    assert len(snapshot) == sum(len(d.records) for d in days)
    # Landmarks that several days saw are one.
    assert len(snapshot.landmarks().positions) < 0.7 * sum(len(r.submap.landmarks) for d in days for r in d.records)
    for key, end in zip(snapshot.keys, (snapshot.poses[e] for e in merged.map.state.graph.ends), strict=True):
        radius = np.linalg.norm(end[:2, 3] - [0.0, RADIUS])
        assert radius == pytest.approx(RADIUS, abs=0.25), key


def test_the_order_of_the_maps_and_workers_change_no_byte(days):
    first = packed(merge(days, GlobalMapConfig(), InProcess()))
    assert_same_bytes(first, packed(merge(days[::-1], GlobalMapConfig(), InProcess())))


@pytest.mark.slow
def test_workers_change_no_byte(days):
    pytest.importorskip("distributed")
    first = packed(merge(days, GlobalMapConfig(), InProcess()))
    with cluster(workers=2) as tasks:
        assert_same_bytes(first, packed(merge([days[1], days[0], days[2]], GlobalMapConfig(), tasks)))


def test_marks_stay_on_the_submaps_that_they_hang_on(days):
    marked = GlobalMap()
    for record in days[1].records:
        marked.add(record.submap)
    marked.settle()
    at = marked.marks.add(marked.state.poses, marked.state.end(2)[:3, 3] + [0.3, 0.2, 0.1])
    first = NamedMap("marked", marked.stored())
    merged = merge([days[0], first], GlobalMapConfig(), InProcess()).map
    (mark,) = merged.marks.marks
    assert mark.name == at.name
    np.testing.assert_array_equal(mark.point, at.point)
    node = marked.state.graph.ends.tolist().index(at.node)
    key = marked.state.graph.records[node].key
    assert mark.node == merged.state.graph.records[merged.agents.record(*key)].end


def test_what_was_found_ahead_changes_nothing(days):
    """A map whose submaps are all compared where they are asked for has the same bytes."""
    union = united(days)
    plain = GlobalMap()
    for submap in union.submaps:
        plain.add(submap)
    looks = AcrossMaps(union, GlobalMapConfig().closure, InProcess()).looks()
    assert any(found is not None for found in looks.values())
    plain.settle()
    merged = merge(days, GlobalMapConfig(), InProcess()).map
    for name, value in storage.pack(plain.stored()).arrays.items():
        other = storage.pack(merged.stored()).arrays[name]
        if value.dtype.kind == "f":  # the last optimum comes from another factor
            np.testing.assert_allclose(other, value, rtol=1e-5, atol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(other, value, err_msg=name)


def test_maps_that_share_no_place_stay_parts(days):
    merged = merge([days[0], day(5, world_seed=9)], GlobalMapConfig(), InProcess())
    assert sorted(merged.parts) == [("day 1",), ("day 5",)]
    assert merged.closures == 0


def test_an_agent_whose_session_another_map_has_is_renamed_and_that_is_said(days):
    other = day(1, turns=(0.3, 1.0))
    shifted = NamedMap("other", other.stored)
    merged = merge([days[0], shifted], GlobalMapConfig(), InProcess())
    agents = {agent for agent, _, _ in merged.map.snapshot().keys}
    assert agents == {"", "rig_2"}
    assert any("'rig_2'" in note for note in merged.notes)


def test_a_map_that_was_extended_from_another_is_taken_once(days):
    extended = GlobalMap()
    for record in (*days[0].records, *days[1].records):
        extended.add(record.submap)
    extended.settle()
    merged = merge([days[0], NamedMap("extended", extended.stored())], GlobalMapConfig(), InProcess())
    assert len(merged.map.snapshot()) == len(days[0].records) + len(days[1].records)
    assert any("day 1: all its submaps" in note for note in merged.notes)
    assert len(merged.parts) == 1


def test_maps_of_other_features_and_no_map_are_refused(days):
    with pytest.raises(ValueError, match="no map"):
        merge([], GlobalMapConfig(), InProcess())
    submap = days[0].records[0].submap
    other = GlobalMap()
    other.add(replace(submap, descriptors=submap.descriptors[:, :64].copy()))
    with pytest.raises(ValueError, match="different features"):
        merge([days[0], NamedMap("other", other.stored())], GlobalMapConfig(), InProcess())
