# SPDX-License-Identifier: Apache-2.0
"""``slam anchor``: files in the building's frame, the page to click on, and what is refused in one line."""

from __future__ import annotations

import shlex
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from judging import join
from submap_world import Agent, circle, ring_world

from browser import Browser, find_chromium
from dense_mapping.plans.floor_plan import FREE, OCCUPIED, FloorPlan
from dense_mapping.plans.plan_io import write_plan
from slam_bringup.cli import slam
from slam_core.geometry import make_transform, rotation_from_euler, transform_points
from slam_core.storage.anchor_file import read_anchor
from slam_core.trajectory import Trajectory, read_trajectory, write_tum
from slam_viewer.page.run_folder import read_trajectories

CELL, PX = 0.1, 0.04
T_MAP_FLOOR = make_transform(rotation_from_euler(0.3, 0.1, -0.05), np.array([-6.0, -6.0, -1.2]))
"""A map that does not lie level."""
CORNERS = np.array([[1.0, 1.0], [11.0, 1.0], [11.0, 9.0], [1.0, 9.0]])
"""Of the walls, in the frame of the floor."""
CHROMIUM = find_chromium()


def call(*arguments: object):
    return CliRunner().invoke(slam, [str(a) for a in arguments])


def building_of(floor: np.ndarray) -> np.ndarray:
    """The building's frame is that of the floor turned by 90 degrees to the left, and 13 m to the right."""
    return np.column_stack([13.0 - floor[:, 1], floor[:, 0]])


def pixels_of(floor: np.ndarray) -> np.ndarray:
    building = building_of(floor)
    return np.column_stack([building[:, 0], 13.0 - building[:, 1]]) / PX


def pairs(floor: np.ndarray = CORNERS) -> list[str]:
    places = transform_points(T_MAP_FLOOR, np.column_stack([floor, np.zeros(len(floor))]))
    return [
        f"--at={x:.4f},{y:.4f}={u:.2f},{v:.2f}"
        for (x, y, _), (u, v) in zip(places, pixels_of(floor), strict=True)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def map_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("map") / "map"
    rng = np.random.default_rng(5)
    joined, _ = join(Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.5), rng, "").submaps()[:3])
    joined.save(folder)
    return folder


@pytest.fixture
def run(map_folder, tmp_path) -> Path:
    """A finished run, as far as the command reads it: map, trajectory, and the plan of a room of 10 x 8 m."""
    out = tmp_path / "run"
    out.mkdir()
    (out / "map").symlink_to(map_folder)
    (out / "summary.json").write_text("{}")
    walk = np.column_stack([np.linspace(2, 10, 20), np.linspace(2, 8, 20), np.full(20, 1.5)])
    poses = np.stack([T_MAP_FLOOR @ make_transform(np.eye(3), p) for p in walk])
    write_tum(out / "trajectory.tum", Trajectory(np.arange(20) * 10**8, poses))
    cells = np.full((100, 120), FREE, dtype=np.int8)
    cells[10:90, [10, 109]] = cells[[10, 89], 10:110] = OCCUPIED
    write_plan(out / "floor_plan.yaml", FloorPlan(cells, CELL, T_MAP_FLOOR))
    return out


@pytest.fixture
def plan(tmp_path) -> Path:
    """The building's plan of that room, drawn 13 x 13 m large."""
    image = np.full((325, 325, 3), 255, dtype=np.uint8)
    cv2.polylines(image, [np.rint(pixels_of(CORNERS)).astype(np.int32)], True, (0, 0, 0), 3)
    assert cv2.imwrite(str(tmp_path / "plan.png"), image)
    return tmp_path / "plan.png"


@pytest.mark.parametrize("resolution", [["--resolution", PX], []])
def test_a_map_that_is_not_level_lies_on_the_floor_of_the_building(run, plan, resolution):
    done = call("anchor", run, plan, *pairs(), *resolution)
    assert done.exit_code == 0, done.output
    assert done.output.count(": off by 0.00") == 4
    anchor = read_anchor(run / "anchor.yaml")
    assert (anchor.frame, anchor.map_frame) == ("building", "map")
    assert anchor.plan["resolution"] == pytest.approx(PX, rel=1e-3)
    assert ("resolution_sigma" in anchor.plan) is not bool(resolution)
    floor = np.array([[3.0, 4.0], [8.0, 2.0]])
    heights = np.array([0.0, 2.0])
    found = transform_points(anchor.T, transform_points(T_MAP_FLOOR, np.column_stack([floor, heights])))
    np.testing.assert_allclose(found, np.column_stack([building_of(floor), heights]), atol=5e-3)
    assert np.linalg.eigvalsh(anchor.covariance).min() > 0.0
    moved = read_trajectory(run / "trajectory_building.tum")
    np.testing.assert_allclose(moved.poses[0, :3, 3], [11.0, 2.0, 1.5], atol=5e-3)
    assert list(read_trajectories(run)) == [""], "slam view takes the trajectory in the building for an agent"


def test_walls_of_the_map_lie_on_those_of_the_plan_in_the_picture(run, plan):
    assert call("anchor", run, plan, *pairs(), "--resolution", PX).exit_code == 0
    picture = cv2.imread(str(run / "anchored_plan.png"))
    scale = picture.shape[0] / 325
    blue, _, red = cv2.split(picture.astype(int))
    is_wall = (red - blue > 60) & (red > 120)
    for a, b in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        for share in (0.3, 0.5, 0.7):
            u, v = np.rint(pixels_of(a[None] * (1 - share) + b[None] * share)[0] * scale).astype(int)
            assert is_wall[v - 12 : v + 13, u - 12 : u + 13].any(), (a, b, share)
    assert not is_wall[int(0.4 * picture.shape[0]) : int(0.6 * picture.shape[0]), picture.shape[1] // 2].any()


def test_a_map_server_yaml_says_where_the_building_has_its_origin(run, plan):
    yaw = np.pi / 2
    content = {"image": plan.name, "resolution": PX, "origin": [100.0, 50.0, yaw]}
    plan.with_suffix(".yaml").write_text(yaml.safe_dump(content))
    done = call("anchor", run, plan.with_suffix(".yaml"), *pairs())
    assert done.exit_code == 0, done.output
    anchor = read_anchor(run / "anchor.yaml")
    x, y = building_of(np.array([[3.0, 4.0]]))[0]
    found = transform_points(anchor.T, transform_points(T_MAP_FLOOR, np.array([[3.0, 4.0, 0.0]])))[0]
    np.testing.assert_allclose(found, [100.0 - y, 50.0 + x, 0.0], atol=5e-3)


def test_points_come_from_a_file_with_their_own_standard_deviation(run, plan, tmp_path):
    rows = [pair.removeprefix("--at=").split("=") for pair in pairs()]
    points = [{key: [float(w) for w in side.split(",")] for key, side in zip(("map", "plan"), row)} for row in rows]  # noqa: B905
    (tmp_path / "points.yaml").write_text(yaml.safe_dump({"points": [points[0] | {"sigma_px": 1.0}, *points[1:]]}))
    done = call("anchor", run, plan, "--points", tmp_path / "points.yaml", "--resolution", PX)
    assert done.exit_code == 0, done.output
    written = yaml.safe_load((run / "anchor.yaml").read_text())["points"]
    assert [p["sigma_px"] for p in written] == [1.0, 3.0, 3.0, 3.0]
    (tmp_path / "points.yaml").write_text("points: [{map: [1, 2]}]")
    done = call("anchor", run, plan, "--points", tmp_path / "points.yaml")
    assert "point 1: it lacks 'plan'" in str(done.exception)


def test_a_point_that_contradicts_the_others_is_named(run, plan):
    *right, wrong = pairs()
    off = wrong.replace("=", " ").split()[1].split(",")
    wrong = f"--at={off[0]},{off[1]}=200,30"
    done = call("anchor", run, plan, *right, wrong)
    assert done.exit_code == 0, done.output
    assert "point 4" in next(line for line in done.output.splitlines() if "left out" in line)
    done = call("anchor", run, plan, *right[:2], wrong, "-o", run.parent / "other", "--resolution", PX)
    assert "disagree" in str(done.exception)
    assert not (run.parent / "other").exists()


def test_files_of_others_stay_and_own_ones_are_replaced(run, plan):
    (run / "trajectory_building.tum").write_text("mine")
    done = call("anchor", run, plan, *pairs(), "--overwrite")
    assert "trajectory_building.tum was not written by slam anchor" in str(done.exception)
    assert (run / "trajectory_building.tum").read_text() == "mine"
    assert not (run / "anchor.yaml").exists()
    (run / "trajectory_building.tum").unlink()
    assert call("anchor", run, plan, *pairs()).exit_code == 0
    assert call("anchor", run, plan, *pairs()[:3]).exit_code == 0
    (run / "anchored_plan.png").write_bytes(b"edited")
    done = call("anchor", run, plan, *pairs())
    assert "changed since" in str(done.exception)
    assert call("anchor", run, plan, *pairs(), "--overwrite").exit_code == 0
    assert not list(run.glob(".slam*"))
    (run / "anchor.html").write_text("mine")
    assert "anchor.html was not written by slam anchor" in str(call("anchor", run, plan).exception)
    (run / "anchor.yaml").write_text("frame: mine")
    assert "anchor.yaml was not written by slam anchor" in str(call("anchor", run, plan, *pairs()).exception)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--at", "1,2=3"], "a pair of points is X,Y=U,V"),
        (["--at", "0,0=1,1"], "2 to 60 pairs"),
        (["--at", "nan,0=1,1", "--at", "5,5=100,100"], "finite"),
        (["--at", "0,0=1,1", "--at", "5,5=326,100"], "point 2 is not on the plan"),
        (["--at", "0,0=1,1", "--at", "5,5=1,1"], "coincide on the plan"),
        (["--storey", "2"], "no storey 2"),
    ],
)
def test_bad_points_are_refused_in_one_line(run, plan, arguments, said):
    done = call("anchor", run, plan, *arguments)
    assert isinstance(done.exception, ValueError)
    assert said in str(done.exception)
    assert not (run / "anchor.yaml").exists()


def test_bad_plans_are_refused_in_one_line(run, tmp_path):
    (tmp_path / "plan.png").write_bytes(b"no image")
    assert "is no image that can be read" in str(call("anchor", run, tmp_path / "plan.png").exception)
    (tmp_path / "plan.yaml").write_text("image: plan.png\nresolution: -1")
    assert "must be positive" in str(call("anchor", run, tmp_path / "plan.yaml").exception)
    cv2.imwrite(str(tmp_path / "good.png"), np.full((9, 9), 255, np.uint8))
    assert "holds no map" in str(call("anchor", tmp_path, tmp_path / "good.png").exception)


def test_a_map_folder_alone_is_anchored_by_its_landmarks_into_another_folder(map_folder, plan, tmp_path):
    two = ["--at=0,0=100,200", "--at=4,0=200,200"]
    assert "say -o FOLDER" in str(call("anchor", map_folder, plan, *two).exception)
    done = call("anchor", map_folder, plan, *two, "-o", tmp_path / "anchored")
    assert done.exit_code == 0, done.output
    assert "nothing checks two points" in done.output
    assert len(read_trajectory(tmp_path / "anchored" / "trajectory_building.tum")) > 10
    sigma = np.sqrt(np.diag(read_anchor(tmp_path / "anchored" / "anchor.yaml").covariance))
    assert sigma[2] >= 1.0, "the height of a map without a floor plan is not known"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_command_of_the_page_is_that_of_the_points_that_are_clicked(run, plan):
    done = call("anchor", run, plan)
    assert done.exit_code == 0, done.output
    assert str(run / "anchor.html") in done.output
    with Browser(CHROMIUM) as browser:
        browser.open((run / "anchor.html").as_uri())
        browser.wait("document.querySelector('#plan img').complete && document.querySelector('#map img').complete")
        time.sleep(0.5)
        for corner in CORNERS:  # pixels of the map's picture, of 10 x 12 m
            for side, (u, v) in (("map", corner / [12.0, -10.0] + [0, 1]), ("plan", pixels_of(corner[None])[0] / 325)):
                at = f"document.querySelector('#{side} img').getBoundingClientRect()"
                x, y, width, height = (browser.evaluate(f"{at}.{k}") for k in ("x", "y", "width", "height"))
                browser.click(x + u * width, y + v * height)
        typed = browser.evaluate("document.querySelector('textarea').value")
        browser.evaluate("document.querySelector('#undo').click()")
        assert browser.evaluate("document.querySelector('textarea').value").count("--at") == 3
        assert browser.errors == []
        assert all(address.startswith(("file:", "data:")) for address in browser.requests)
    program, *words = shlex.split(typed)
    assert program == "slam"
    done = call(*words)
    assert done.exit_code == 0, done.output
    anchor = read_anchor(run / "anchor.yaml")
    found = transform_points(anchor.T, T_MAP_FLOOR[None, :3, 3])[0]
    np.testing.assert_allclose(found, [13.0, 0.0, 0.0], atol=0.15)  # a click is a whole pixel of the screen
