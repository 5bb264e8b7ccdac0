# SPDX-License-Identifier: Apache-2.0
"""Things that were moved between days: the earlier map's landmarks of them are let go, and that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submap_world import Agent, World, circle, room

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.loop_closure.association import PointSet
from sjsam_node.loop_closure.verification import Verifier
from sjsam_node.merging.across import AcrossMaps
from sjsam_node.merging.merge import merge
from sjsam_node.merging.moved import moved_between, without
from sjsam_node.merging.union import NamedMap, united
from sjsam_node.regions.tasks import InProcess

SHIFT = np.array([0.9, -0.4, 0.0])
THING = 30
"""Landmarks of a cupboard that somebody moves."""


def building() -> World:
    """A room whose last landmarks are a cupboard in it."""
    rng = np.random.default_rng(4)
    cupboard = np.array([2.6, 2.2, 0.4]) + rng.uniform(-0.5, 0.5, (THING, 3)) * [0.5, 0.8, 1.2]
    return World.random(np.concatenate([room((1.0, 1.5), (8.0, 8.0), 400, rng), cupboard]), rng)


def mapped(number: int, world: World) -> tuple[NamedMap, list[np.ndarray]]:
    """The map of a day, and what of the world each submap shows."""
    agent = Agent(
        world, circle(1.5, 1.0), np.random.default_rng(100 + number), "", stamp_ns=10**9 * (1000 * number + 1)
    )
    built = GlobalMap()
    for submap in agent.submaps():
        assert built.add(replace(submap, session=number)).accepted
    return NamedMap(f"day {number}", built.stored()), agent.seen


@pytest.fixture(scope="module")
def days() -> dict[str, tuple[NamedMap, list[np.ndarray]]]:
    world = building()
    moved = np.concatenate([world.points[:-THING], world.points[-THING:] + SHIFT])
    return {
        "before": mapped(1, world),
        "after": mapped(2, World(moved, world.descriptors)),
        "same": mapped(3, world),
    }


def of_thing(seen: list[np.ndarray]) -> int:
    """Observations of the cupboard in the submaps of a day."""
    return sum(int((one >= 400).sum()) for one in seen)


def test_what_was_moved_is_let_go_of_the_earlier_day_alone_and_that_is_said(days):
    (before, seen), (after, _) = days["before"], days["after"]
    assert of_thing(seen) > THING
    merged = merge([after, before], GlobalMapConfig(), InProcess())
    assert len(merged.parts) == 1
    (note,) = merged.notes
    assert note.startswith("day 1: ")
    assert "day 2 shows them 1.0 m elsewhere" in note
    told = int(note.split()[2])
    assert 0.5 * THING <= told <= THING
    records = merged.map.state.graph.records
    for record, one, was in zip(records[: len(seen)], seen, before.records, strict=True):
        kept = np.isin(was.submap.landmark_ids, record.submap.landmark_ids)
        assert kept[one < 400].all()  # nothing of the walls is let go
    left = sum(len(r.submap.landmarks) for r in records[: len(seen)]) - sum(int((s < 400).sum()) for s in seen)
    assert left <= 0.4 * of_thing(seen)
    for record, was in zip(records[len(seen) :], after.records, strict=True):
        np.testing.assert_array_equal(record.submap.landmarks, was.submap.landmarks)


def test_a_merged_map_is_merged_with_one_that_it_was_made_of_and_what_was_let_go_stays_so(days):
    (before, _), (after, _) = days["before"], days["after"]
    merged = NamedMap("merged", merge([before, after], GlobalMapConfig(), InProcess()).map.stored())
    ids = {r.key: r.submap.landmark_ids for r in merged.records}
    assert any(len(ids[r.key]) < len(r.submap.landmark_ids) for r in before.records)
    for other in (before, after):
        for maps in ([merged, other], [other, merged]):
            union = united(maps)
            assert [ids[s.agent, s.session, s.index].tolist() for s in union.submaps] == [
                s.landmark_ids.tolist() for s in union.submaps
            ]
            assert len(union.submaps) == len(ids)
    again = merge([before, merged], GlobalMapConfig(), InProcess())
    assert again.notes == ("day 1: all its submaps are in the others; it adds nothing",)


def test_the_order_of_two_maps_of_the_same_submaps_does_not_count(days):
    """One let landmarks go, the other did not."""
    (before, _), (after, _) = days["before"], days["after"]
    thinned = NamedMap("thinned", merge([before, after], GlobalMapConfig(), InProcess()).map.stored())
    whole = GlobalMap()
    for record in (*before.records, *after.records):
        assert whole.add(record.submap).accepted
    maps = [thinned, NamedMap("whole", whole.stored())]
    first, second = (united(given).submaps for given in (maps, maps[::-1]))
    assert [len(s.landmarks) for s in first] == [len(s.landmarks) for s in second]


def test_nothing_is_let_go_where_nothing_was_moved(days):
    union = united([days["before"][0], days["same"][0]])
    across = AcrossMaps(union, GlobalMapConfig().closure, InProcess())
    assert any(place is not None for place in across.looks.values())
    assert across.moved() == []
    thinned = without(union, [])
    assert thinned.notes == union.notes
    assert all(a is b for a, b in zip(thinned.submaps, union.submaps, strict=True))


def test_landmarks_of_the_place_that_were_not_matched_have_not_moved(days):
    """Half of the pairs are taken out of the place's alignment: what is left agrees on the place's own motion."""
    union, verifier = united([days["before"][0], days["same"][0]]), Verifier()
    places = AcrossMaps(union, GlobalMapConfig().closure, InProcess()).looks
    tried = 0
    for (first, second), place in places.items():
        if place is None or len(place.pairs) < 40:
            continue
        one, other = (
            PointSet(s.landmarks, s.covariance[6:, 6:], s.descriptors)
            for s in (union.submaps[first], union.submaps[second])
        )
        half = replace(place, pairs=place.pairs[::2])
        left = [np.setdiff1d(np.arange(len(s.points)), half.pairs[:, k]) for k, s in enumerate((one, other))]
        again = verifier.by_looks(one.select(left[0]), other.select(left[1]), (first, second))
        assert again is not None
        assert moved_between(verifier, one, other, half, (first, second)) is None
        tried += 1
    assert tried >= 3
