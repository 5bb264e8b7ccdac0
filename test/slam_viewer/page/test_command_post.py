# SPDX-License-Identifier: Apache-2.0
"""The command post on a drawn floor plan: ways out, storeys, what nobody has seen."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, UNKNOWN, FloorPlan
from slam_core.geometry import make_transform
from slam_core.types import PoseEstimate
from slam_viewer.page.command_post import storey_at, unseen, ways_out
from slam_viewer.page.picture_of_plan import plan_picture

DRAWN = """
##########..
#......#....
#......#....
#...........
#......#....
#......#....
##########..
"""
"""Half a metre per character: a room, a door of half a metre, and beyond it what was seen through the door."""


def drawn_plan(height: float = 0.0) -> FloorPlan:
    rows = [line for line in DRAWN.strip().splitlines()][::-1]
    table = {"#": OCCUPIED, ".": FREE}
    coarse = np.array([[table[c] for c in row] for row in rows], dtype=np.int8)
    cells = np.kron(coarse, np.ones((5, 5), dtype=np.int8))
    cells = np.pad(cells, 5, constant_values=UNKNOWN)
    return FloorPlan(cells, 0.1, make_transform(np.eye(3), np.array([-0.5, -0.5, height])))


def agent_at(x: float, y: float, z: float = 1.2, sigma: float = 0.02) -> PoseEstimate:
    T = make_transform(np.eye(3), np.array([x, y, z]))
    return PoseEstimate(0, T, np.diag([sigma**2] * 3 + [1e-4] * 3))


def test_the_way_out_goes_through_the_door_and_says_how_sure_it_is():
    (out,) = ways_out([drawn_plan()], {"one": agent_at(1.0, 1.0)}, {"one": np.array([[5.5, 1.0, 0.0]])})
    assert out.route is not None
    at_wall = out.route.points[np.abs(out.route.points[:, 0] - 3.75) < 0.2]
    assert np.all(np.abs(at_wall[:, 1] - 1.75) < 0.3)
    assert 4.7 < out.route.length < 6.0
    assert out.radius == pytest.approx(0.02 * 3.255, rel=0.01)
    assert "m to the exit" in out.text
    assert "wide at its narrowest" in out.text


def test_an_agent_behind_a_wall_without_a_door_has_no_way_out():
    plan = drawn_plan()
    plan.cells[:, 40:45] = OCCUPIED
    (out,) = ways_out([plan], {"one": agent_at(1.0, 1.0)}, {"one": np.array([[5.5, 1.0, 0.0]])})
    assert out.route is None
    assert out.text == "no way out through what was seen free or walked on"


def test_who_has_walked_through_what_nobody_saw_finds_the_way_back():
    plan = drawn_plan()
    plan.cells[:, 30:45] = UNKNOWN
    x = np.arange(1.0, 5.6, 0.3)
    path = np.stack([x, np.where(x < 3.0, 1.0, 1.7), np.full_like(x, 1.2)], axis=1)
    agents = {"one": agent_at(*path[0]), "two": agent_at(5.5, 1.7)}
    two = path[-1:]
    assert ways_out([plan], agents, {"one": path[-2:], "two": two})[0].route is None
    one, _ = ways_out([plan], agents, {"one": path[::-1], "two": two})
    assert one.route is not None
    assert 4.5 < one.route.length < 6.0
    crossing = path[[0, -1]]
    assert ways_out([plan], agents, {"one": crossing[::-1], "two": two})[0].route is None, "nobody saw what is between"


def test_a_position_that_nothing_ties_to_the_map_is_not_told_in_metres():
    lost = {"one": agent_at(1.0, 1.0, sigma=100.0)}
    (out,) = ways_out([drawn_plan()], lost, {"one": np.array([[5.5, 1.0, 0.0]])})
    assert "not tied to the map" in out.text


def test_each_agent_is_on_the_highest_floor_below_it():
    plans = [drawn_plan(0.0), drawn_plan(3.0)]
    assert storey_at(plans, np.array([1.0, 1.0, 1.2])) is plans[0]
    assert storey_at(plans, np.array([1.0, 1.0, 4.2])) is plans[1]
    assert storey_at([], np.zeros(3)) is None
    upstairs = {"two": agent_at(1.0, 1.0, 4.2)}
    (out,) = ways_out(plans, upstairs, {"two": np.array([[5.5, 1.0, 0.0]])})
    assert out.route is None, "stairs are on no plan"


def test_borders_of_what_was_seen_are_told_the_longest_first():
    borders = unseen([drawn_plan()])
    assert borders
    assert all(a.length >= b.length for a, b in itertools.pairwise(borders))
    assert all(b.point[0] > 3.5 for b in borders), "the room itself has walls all round"


def test_the_picture_of_a_plan_has_the_highest_y_first_and_hides_the_unknown():
    picture = plan_picture(drawn_plan())
    assert picture.shape == (45, 70, 4)
    assert picture[0, 0, 3] == 0
    assert picture[-8, 8, 3] == 255, "the lower left corner of the drawing is a wall"
