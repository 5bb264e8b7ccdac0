# SPDX-License-Identifier: Apache-2.0
"""Finished maps become one: tied by places, of the same bytes in any order and with any number of workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.graph.map_graph import BUILDING
from sjsam_node.graph.marks import Marks
from sjsam_node.loop_closure.detector import RecordPair
from sjsam_node.loop_closure.point_sets import at_start
from sjsam_node.loop_closure.verification import Verifier
from sjsam_node.map_file import storage
from sjsam_node.merging.across import AcrossMaps
from sjsam_node.merging.by_records import ByRecords
from sjsam_node.merging.merge import merge
from sjsam_node.merging.union import NamedMap, united
from sjsam_node.regions.tasks import InProcess, cluster
from sjsam_node.tags.known_tags import KnownTagsConfig

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


@pytest.fixture(scope="module")
def merged_days(days):
    """The three in one map, which no test changes."""
    return merge(days, GlobalMapConfig(), InProcess())


def packed(merged) -> tuple[dict, dict]:
    one = storage.pack(merged.map.stored())
    return one.manifest, {name: np.array(value) for name, value in one.arrays.items()}


def assert_same_bytes(first, second):
    assert first[0] == second[0]
    assert first[1].keys() == second[1].keys()
    for name, value in first[1].items():
        assert value.tobytes() == second[1][name].tobytes(), name


def test_maps_of_days_and_agents_become_one_map_at_its_optimum(days, merged_days):
    merged = merged_days
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


def test_the_order_of_the_maps_changes_no_byte(days, merged_days):
    first = packed(merged_days)
    assert_same_bytes(first, packed(merge(days[::-1], GlobalMapConfig(), InProcess())))


@pytest.mark.slow
def test_workers_change_no_byte(days, merged_days):
    pytest.importorskip("distributed")
    first = packed(merged_days)
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


def test_what_was_found_ahead_changes_nothing(days, merged_days):
    """A map whose submaps are all compared where they are asked for has the same bytes."""
    union = united(days)
    plain = GlobalMap()
    for submap in union.submaps:
        plain.add(submap)
    looks = AcrossMaps(union, GlobalMapConfig().closure, InProcess()).looks
    assert any(found is not None for found in looks.values())
    plain.settle()
    merged = merged_days.map
    for name, value in storage.pack(plain.stored()).arrays.items():
        other = storage.pack(merged.stored()).arrays[name]
        if value.dtype.kind == "f":  # the last optimum comes from another factor
            np.testing.assert_allclose(other, value, rtol=1e-5, atol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(other, value, err_msg=name)


def assert_same_ways(merged: GlobalMap, other: GlobalMap):
    """The same poses, but for the frame and a last optimum from elsewhere."""
    for agent, path in other.path().items():
        ways = [np.array([e.T for e in p]) for p in (merged.path()[agent], path)]
        first, second = (np.linalg.inv(T[0]) @ T for T in ways)
        np.testing.assert_allclose(first, second, atol=1e-3)


def with_known_tags(folder, number: int = 1, x: float = 0.0) -> GlobalMapConfig:
    file = folder / "known.yaml"
    tag = f"{{id: {number}, position: [{x}, 0, 0], quaternion: [0, 0, 0, 1]}}"
    file.write_text(f"size: 0.2\nsigma: 0.01\nsigma_angle: 0.01\ntags: [{tag}]\n")
    return replace(GlobalMapConfig(), tags=KnownTagsConfig(known=str(file)))


def test_known_tags_of_the_building_change_no_part_closure_or_way(days, merged_days, tmp_path):
    plain = merged_days
    merged = merge(days, with_known_tags(tmp_path), InProcess())
    assert merged.map.state.graph.records[0].submap.agent == BUILDING
    assert (merged.parts, merged.closures, merged.notes) == (plain.parts, plain.closures, ())
    assert_same_ways(merged.map, plain.map)


def knowing_tags(one: NamedMap, config: GlobalMapConfig) -> NamedMap:
    """A map of the first submap alone, made with known tags of the building."""
    built = GlobalMap(config)
    assert built.add(one.records[0].submap).accepted
    return NamedMap(one.name, built.stored())


@pytest.mark.parametrize(("number", "x"), [(2, 0.0), (1, 0.5)])
def test_maps_that_know_other_tags_of_the_building_are_refused_and_those_of_the_same_are_one(days, tmp_path, number, x):
    first = knowing_tags(days[0], with_known_tags(tmp_path))
    second = knowing_tags(days[1], with_known_tags(tmp_path))
    assert [s.agent for s in united([first, second]).submaps].count(BUILDING) == 1
    other = knowing_tags(days[1], with_known_tags(tmp_path, number, x))
    with pytest.raises(ValueError, match="knows other tags of the building than another map"):
        united([first, other])


@pytest.mark.parametrize(("has_known_tags", "is_one_bent"), [(True, False), (False, True), (True, True)])
def test_what_was_found_ahead_is_of_the_records_that_it_is_asked_for(days, tmp_path, has_known_tags, is_one_bent):
    """With a record that the map has placed itself, and a submap that it refused."""
    union = united([with_bent_submap(days[0]) if is_one_bent else days[0], *days[1:]])
    config = with_known_tags(tmp_path) if has_known_tags else GlobalMapConfig()
    joined = GlobalMap(config)
    ahead = ByRecords(joined, union, AcrossMaps(union, config.closure, InProcess()))
    for submap in union.submaps:
        joined.add_again(submap)
    records, verifier = joined.state.graph.records, Verifier(config.closure)
    assert len(records) == len(union.submaps) + has_known_tags - is_one_bent
    assert len(ahead) >= 10
    for (first, second), found in ahead.items():
        seed = ahead.number(first), ahead.number(second)
        expected = verifier.by_looks(at_start(records[first]), at_start(records[second]), seed)
        assert (found is None) == (expected is None)
        assert found is None or found.T.tobytes() == expected.T.tobytes()
    wanted = [RecordPair(*pair, None, 0.0, True) for pair in [*list(ahead)[:5], (0, 1), list(ahead)[5]]]
    for one, (found, _) in zip(wanted, ahead.compare(wanted), strict=True):
        seed = [one.first if ahead.number(one.first) is None else ahead.number(i) for i in (one.first, one.second)]
        points = at_start(records[one.first]), at_start(records[one.second])
        expected, _ = verifier.verify(*points, None, 0.0, *seed)
        assert (found is None) == (expected is None)
        assert found is None or found.T.tobytes() == expected.T.tobytes()


def with_bent_submap(one: NamedMap) -> NamedMap:
    """The map with a second submap that no map takes."""
    state, place = one.stored.state, 1
    record = one.records[place]
    bent = replace(record, submap=replace(record.submap, end_pose=2.0 * record.submap.end_pose))
    graph = replace(state.graph, records=(*one.records[:place], bent, *one.records[place + 1 :]))
    return NamedMap("faulty", replace(one.stored, state=replace(state, graph=graph)))


def test_a_submap_that_is_refused_is_said_and_the_others_are_joined(days):
    faulty = with_bent_submap(days[0])
    merged = merge([faulty, *days[1:]], GlobalMapConfig(), InProcess())
    assert any("1 submaps could not be joined" in note and "rigid" in note for note in merged.notes)
    plain = GlobalMap()
    for submap in united([faulty, *days[1:]]).submaps:
        plain.add(submap)
    plain.settle()
    assert merged.map.snapshot().keys == plain.snapshot().keys
    assert len(merged.parts) == plain.components == 1
    assert_same_ways(merged.map, plain)


def test_maps_that_share_no_place_stay_parts(days):
    merged = merge([days[0], day(5, world_seed=9)], GlobalMapConfig(), InProcess())
    assert sorted(merged.parts) == [("day 1",), ("day 5",)]
    assert merged.closures == 0


def test_maps_whose_submaps_are_too_sure_of_themselves_stay_one_map():
    """Maps of one submap each contradict nothing once their closures are gone: that does not speak against these."""
    short = [day(k, turns=(0.03 * k, 0.03 * k + 0.1)).records[0].submap for k in range(1, 6)]
    maps = []
    for k, submap in enumerate(short):
        built = GlobalMap()
        built.add(replace(submap, covariance=submap.covariance / 25.0))
        maps.append(NamedMap(f"day {k}", built.stored()))
    merged = merge(maps, GlobalMapConfig(), InProcess())
    assert len(merged.parts) == 1
    assert "contradict each other" in merged.map.snapshot().overconfidence


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


def built_of(name: str, *parts: NamedMap) -> NamedMap:
    """The map of the submaps of some maps, as one that was extended from another has them."""
    built = GlobalMap()
    for record in (record for part in parts for record in part.records):
        assert built.add(record.submap).accepted
    return NamedMap(name, built.stored())


def marked(one: NamedMap, record: int, name: str) -> NamedMap:
    """The map with a mark near the end of a record."""
    marks = Marks(list(one.stored.marks.marks))
    state = one.stored.state
    marks.add(state.poses, state.end(record)[:3, 3] + [0.3, 0.2, 0.1], name)
    return NamedMap(one.name, replace(one.stored, marks=marks))


def moved_in_time(one: NamedMap, seconds: int, keep: slice = slice(None)) -> NamedMap:
    """The map of some of the same submaps at another time: another rig's, for a merge."""
    built = GlobalMap()
    for record in one.records[keep]:
        s, by = record.submap, seconds * 10**9
        assert built.add(replace(s, start_stamp_ns=s.start_stamp_ns + by, end_stamp_ns=s.end_stamp_ns + by)).accepted
    return NamedMap("another rig", built.stored())


def test_what_was_renamed_is_taken_once_with_its_marks(days):
    """Another rig's map first, then one that was extended from the third: its agent is renamed in the second."""
    rig, first = moved_in_time(days[0], -100), marked(days[0], 2, "door")
    extended = built_of("extended", days[0], days[1])
    union = united([first, extended, rig])
    assert union.names == ("another rig", "extended", "day 1")
    assert len(union.submaps) == len(rig.records) + len(extended.records)
    assert {s.agent for s in union.submaps if s.session == 2} == {"rig_2"}  # one rig's days keep one name
    (mark,) = union.marks
    assert (mark.key, mark.at_end) == (("rig_2", *days[0].records[2].key[1:]), True)


def test_a_merged_map_and_one_of_its_maps_share_what_the_merge_renamed(days):
    rig = moved_in_time(days[0], -100)
    merged = NamedMap("merged", merge([days[0], rig], GlobalMapConfig(), InProcess()).map.stored())
    assert len(united([merged, days[0]]).submaps) == len(merged.records)


def test_a_session_that_goes_on_keeps_the_name_that_its_beginning_has(days):
    half, rig = moved_in_time(days[0], 0, slice(3)), moved_in_time(days[0], -100)
    union = united([half, days[0], rig])
    assert len(union.submaps) == 2 * len(days[0].records)
    assert {s.agent for s in union.submaps} == {"", "rig_2"}


def test_a_mark_on_a_shared_submap_stays_where_another_session_is_renamed(days):
    """The second map shares session 1 with the first one, which has another session 2."""
    other = built_of("other", days[0], moved_in_time(days[1], -50))
    second = marked(built_of("second", days[0], days[1]), 1, "door")
    union = united([other, second])
    assert {(s.agent, s.session) for s in union.submaps} == {("", 1), ("", 2), ("rig_2", 2)}
    (mark,) = union.marks
    assert mark.key == days[0].records[1].key
    (joined,) = merge([other, second], GlobalMapConfig(), InProcess()).map.marks.marks
    assert joined.name == "door"


def test_a_mark_that_two_maps_have_on_a_shared_submap_is_taken_once(days):
    first = marked(days[0], 2, "door")
    extended = built_of("extended", days[0], days[1])  # its first nodes are those of the first map
    extended = marked(replace(extended, stored=replace(extended.stored, marks=first.stored.marks)), 1, "door")
    union = united([first, extended])
    assert sorted((m.mark.name, m.key) for m in union.marks) == [
        ("door", days[0].records[2].key),
        ("door_2", days[0].records[1].key),
    ]
    # A merge before has called one of them by a new name.
    rig = marked(moved_in_time(days[0], -100), 1, "door")
    merged = NamedMap("merged", merge([first, rig], GlobalMapConfig(), InProcess()).map.stored())
    assert sorted(m.mark.name for m in united([merged, first, rig]).marks) == ["door", "door_2"]


def test_maps_of_other_features_and_no_map_are_refused(days):
    with pytest.raises(ValueError, match="no map"):
        merge([], GlobalMapConfig(), InProcess())
    submap = days[0].records[0].submap
    other = GlobalMap()
    other.add(replace(submap, descriptors=submap.descriptors[:, :64].copy()))
    with pytest.raises(ValueError, match="different features"):
        merge([days[0], NamedMap("other", other.stored())], GlobalMapConfig(), InProcess())
