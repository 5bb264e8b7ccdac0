# SPDX-License-Identifier: Apache-2.0
"""Floor plans of a simulated flat: walls where they are, free where one can walk, unknown where nobody looked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dense_mapping.dense_model import DenseModel
from dense_mapping.plans.floor_plan import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    FloorPlan,
    FloorPlanConfig,
    Obstacles,
    _areas,
    _middles,
    _occupied,
)
from dense_mapping.plans.levelling import floor_heights, level_transform, up_direction
from dense_mapping.plans.navigation import frontiers, plan_route
from slam_core.camera import Camera
from slam_core.geometry import OPTICAL_FROM_RIG, boxplus, make_transform, rotation_from_euler, so3_exp
from slam_core.types import DepthImage
from slam_simulation.rendering.raycaster import camera_rays, make_view, trace
from slam_simulation.scenario import Scenario
from slam_simulation.world.surface_table import compile_world

CAMERA = Camera(160, 120, 80.0, 80.0, 79.5, 59.5)
FLAT = {
    "seed": 5,
    "rate": 10.0,
    "frames": 10,
    "rooms": [
        {"name": "a", "x": [0, 4], "y": [0, 3], "style": "office"},
        {"name": "b", "x": [4.2, 8], "y": [0, 3], "style": "office"},
    ],
    "doorways": [{"at": [4.1, 1.5], "width": 1.0}],
    "agents": [{"motion": "rig", "height": 1.2, "path": [[1, 1], [3, 2, 90]]}],
}


def flat_model(
    stations: list[tuple[float, float]], tilt: np.ndarray | None = None, flat: dict[str, Any] = FLAT
) -> DenseModel:
    """A model from full turns at some places; the whole map tilted by a rotation vector."""
    table, rays = compile_world(Scenario.from_mapping("flat", flat).world()), camera_rays(CAMERA)
    T_map_world = make_transform(so3_exp(np.zeros(3) if tilt is None else tilt), np.zeros(3))
    model = DenseModel()
    for x, y in stations:
        for k in range(10):
            R = rotation_from_euler(2 * np.pi * k / 10, 0.3) @ OPTICAL_FROM_RIG.T
            T = make_transform(R, np.array([x, y, 1.2]))
            depth = trace(make_view(table, T, rays.bounds), rays).depth
            depth = np.where(depth > 0, depth, np.nan).astype(np.float32)
            model.add("tof", T_map_world @ T, DepthImage(k, depth, np.full_like(depth, 0.01), CAMERA))
    return model


def value_at(plan: FloorPlan, *points: tuple[float, float, float]) -> list[int]:
    rows, columns = plan.cell_of(np.array(points)).T
    return plan.cells[rows, columns].tolist()


@pytest.fixture(scope="module")
def both_rooms() -> DenseModel:
    return flat_model([(1.5, 1.5), (3.2, 1.5), (4.1, 1.5), (6.0, 1.5)])


def plan_of(model: DenseModel) -> FloorPlan:
    surface = model.surface()
    model.volume.clear()  # is not needed for a plan
    (plan,) = model.floor_plans(surface)
    return plan


def test_walls_are_occupied_rooms_and_the_door_free_and_outside_unknown(both_rooms):
    plan = plan_of(both_rooms)
    assert value_at(plan, (1.5, 1.5, 0), (6.0, 1.5, 0), (4.1, 1.5, 0)) == [FREE] * 3
    row, column = plan.cell_of(np.array([[4.0, 0.5, 0]]))[0]
    near_wall = plan.cells[row, column - 1 : column + 2]
    assert OCCUPIED in near_wall
    assert plan.cells[0, 0] == UNKNOWN
    assert 12.0 < plan.free_m2 < 23.4, "23.4 m2 is both rooms without furniture"


def test_the_walls_of_an_unsymmetrical_flat_stand_where_they_were_built_and_nothing_is_mirrored():
    """Room b reaches 2 m further along y, and its door is not in the middle: no turn or mirror image of it fits."""
    rooms = [{**FLAT["rooms"][0]}, {**FLAT["rooms"][1], "x": [4.2, 6.2], "y": [1, 5]}]
    flat = FLAT | {"rooms": rooms, "doorways": [{"at": [4.1, 2.2], "width": 1.0}]}
    plan = plan_of(flat_model([(1.5, 1.5), (3.0, 2.2), (4.1, 2.2), (5.2, 2.2), (5.2, 3.8)], flat=flat))
    seen = {}
    for room in rooms:
        (x0, x1), (y0, y1) = room["x"], room["y"]
        along_x, along_y = np.arange(x0 + 0.3, x1 - 0.3, 0.05), np.arange(y0 + 0.3, y1 - 0.3, 0.05)
        for name, wall in {
            "south": [(x, y0, 0.0) for x in along_x], "north": [(x, y1, 0.0) for x in along_x],
            "west": [(x0, y, 0.0) for y in along_y], "east": [(x1, y, 0.0) for y in along_y],
        }.items():  # fmt: skip
            at_door = [abs(x - 4.1) < 0.3 and abs(y - 2.2) < 0.6 for x, y, _ in wall]
            rows, columns = plan.cell_of(np.array([p for p, out in zip(wall, at_door, strict=True) if not out])).T
            around = [plan.cells[r - 1 : r + 2, c - 1 : c + 2] for r, c in zip(rows, columns, strict=True)]
            seen[room["name"], name] = np.mean([OCCUPIED in cells for cells in around])
    assert min(seen.values()) > 0.9, seen
    assert value_at(plan, (1.5, 1.5, 0), (5.2, 4.2, 0), (4.1, 2.2, 0)) == [FREE] * 3
    assert value_at(plan, (1.5, 4.2, 0), (5.2, 0.6, 0)) == [UNKNOWN] * 2, "beside the rooms there is nothing"


def test_a_room_nobody_entered_is_a_frontier_at_its_door():
    plan = plan_of(flat_model([(1.5, 1.5), (2.5, 1.5)]))
    beyond = sum(f.length for f in frontiers(plan) if f.point[0] > 4.0)
    assert beyond > 1.0
    assert plan_route(plan, np.array([1.5, 1.5, 0]), frontiers(plan)[0].point) is not None, (
        "and one can go there to look"
    )


def test_a_room_that_was_looked_into_everywhere_has_less_of_a_border(both_rooms):
    one = sum(f.length for f in frontiers(plan_of(flat_model([(1.5, 1.5), (2.5, 1.5)]))) if f.point[0] > 4.0)
    both = sum(f.length for f in frontiers(plan_of(both_rooms)) if f.point[0] > 4.0)
    assert both < one


def test_the_way_out_leads_through_the_door_and_through_no_wall(both_rooms):
    plan = plan_of(both_rooms)
    found = plan_route(plan, np.array([6.0, 1.5, 1.2]), np.array([1.5, 1.5, 1.2]))
    assert found is not None
    assert 4.4 <= found.length < 6.0
    assert set(value_at(plan, *map(tuple, found.points))) == {FREE}
    at_door = found.points[np.argmin(np.abs(found.points[:, 0] - 4.1))]
    assert 1.0 < at_door[1] < 2.0
    assert found.clearance >= 0.1


def test_there_is_no_way_through_what_nobody_has_seen():
    plan = plan_of(flat_model([(1.0, 1.5)]))
    assert plan_route(plan, np.array([1.0, 1.5, 0]), np.array([7.5, 0.5, 0])) is None


def test_a_map_that_starts_tilted_is_levelled_by_its_floor():
    tilt = np.array([0.15, -0.1, 0.0])
    plan = plan_of(flat_model([(1.5, 1.5)], tilt))
    up = so3_exp(tilt)[:, 2]
    assert np.degrees(np.arccos(plan.T_map_plan[:3, 2] @ up)) < 0.3
    assert abs(plan.height_of((so3_exp(tilt) @ [1.5, 1.5, 0.0])[None])[0]) < 0.03


def test_gravity_is_believed_where_there_is_no_level_surface():
    model = flat_model([(1.5, 1.5)])
    empty = DenseModel().surface()
    np.testing.assert_allclose(up_direction(empty, np.array([[0.3, 0, 1.0]]), np.array([0, 0, 9.81])), [0, 0, 1])
    (plan,) = model.floor_plans(model.surface(), np.array([0.05, 0.0, 9.8]))
    assert plan.T_map_plan[2, 2] > 0.9999


def test_two_storeys_are_two_floors():
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(0, 5, (4000, 2)), rng.normal(0, 0.01, 4000)])
    table = np.column_stack([rng.uniform(0, 1, (500, 2)), rng.normal(0.75, 0.01, 500)])
    points = np.concatenate([floor, table, floor + np.array([0, 0, 3.0])])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    cameras = np.array([[1, 1, 1.3], [2, 2, 2.5], [1, 1, 4.3]])
    np.testing.assert_allclose(floor_heights(points, normals, cameras, 2.0, 1.3), [0.0, 3.0], atol=0.01)
    np.testing.assert_allclose(floor_heights(points, normals, cameras[:1], 2.0, 1.3), [0.0], atol=0.01)


def test_a_storey_that_was_seen_little_has_its_floor_all_the_same():
    rng = np.random.default_rng(0)
    upper = np.column_stack([rng.uniform(0, 5, (4000, 2)), rng.normal(3.0, 0.01, 4000)])
    lower, noise = upper[:450] - np.array([0, 0, 3.0]), upper[:60] + np.array([0, 0, 3.0])
    points = np.concatenate([upper, lower, noise])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    cameras = np.array([[1, 1, z] for z in (1.3, 1.3, 1.3, 4.3, 4.3, 4.3, 7.3, 7.3, 7.3)])
    np.testing.assert_allclose(floor_heights(points, normals, cameras, 2.0, 1.3), [0.0, 3.0], atol=0.01)
    np.testing.assert_allclose(floor_heights(points, normals, cameras[2:6], 2.0, 1.3), [3.0], atol=0.01)


def test_levelling_turns_up_into_z(rng):
    for up in rng.normal(size=(20, 3)):
        up = up / np.linalg.norm(up)
        np.testing.assert_allclose(level_transform(up)[:3, :3] @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(level_transform(np.array([0, 0, -1.0]))[:3, :3] @ [0, 0, -1], [0, 0, 1], atol=1e-12)


def test_a_model_of_final_poses_keeps_little_and_has_the_same_plan(both_rooms):
    fixed = DenseModel(both_rooms.config, fixed=True)
    for placed in both_rooms.keyframes:
        fixed.add_keyframe(placed.camera, placed.T_map_camera, placed.keyframe)
    surface = fixed.surface()
    (plan,), (other,) = (model.floor_plans(surface) for model in (both_rooms, fixed))
    np.testing.assert_array_equal(plan.cells, other.cells)
    pixels = [sum(k.keyframe.depth_units.size for k in model.keyframes) for model in (both_rooms, fixed)]
    assert pixels[1] == pixels[0] / 16


def test_a_plan_that_would_fill_the_memory_is_refused_with_what_to_do(both_rooms):
    drifted = boxplus(both_rooms.keyframes[-1].T_map_camera, np.array([5000.0, 0, 0, 0, 0, 0]))
    model = flat_model([(1.5, 1.5)])
    last = both_rooms.keyframes[-1].keyframe
    model.add("tof", drifted, DepthImage(99, last.depth, last.sigma, last.camera))
    model.add("tof", np.eye(4), DepthImage(99, last.depth, last.sigma, last.camera))
    far = boxplus(drifted, np.array([0, 5000.0, 0, 0, 0, 0]))
    model.add("tof", far, DepthImage(100, last.depth, last.sigma, last.camera))
    with pytest.raises(ValueError, match="raise resolution"):
        model.floor_plans(model.surface())


def test_a_table_top_is_drawn_whole_though_its_points_lie_as_wide_apart_as_cells():
    """Points every 3 cm in cells of 5 cm: counted, they would draw a grid."""
    u, v = np.meshgrid(np.arange(0.0, 1.2, 0.03), np.arange(0.0, 1.2, 0.03), indexing="ij")
    points = np.stack([u, v, np.full_like(u, 0.7)], axis=-1).reshape(-1, 3)
    k = np.arange(len(points)).reshape(u.shape)
    corners = [part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:])]
    faces = np.concatenate([np.stack([corners[i] for i in t], axis=1) for t in ((0, 1, 2), (0, 2, 3))])
    middles, areas = (measure(points, faces.astype(np.int32)) for measure in (_middles, _areas))
    assert areas.sum() == pytest.approx(1.17**2)
    occupied = _occupied(Obstacles(middles, areas), np.array([-0.1, -0.1]), FloorPlanConfig(), (30, 30))
    assert occupied[3:24, 3:24].all()
    assert not occupied[:, 27:].any()
