# SPDX-License-Identifier: Apache-2.0
"""Every shipped scenario loads, keeps clear of the furniture and has the size its experiment asks for."""

from pathlib import Path

import numpy as np
import pytest

from slam_core.geometry import FloatArray
from slam_simulation import Scenario
from slam_simulation.lift import seen_path
from slam_simulation.world.world import Rectangle

FOLDER = Path(__file__).resolve().parents[2] / "bags" / "scenarios"
FRAMES = {
    "sweep": 72, "conference": 353, "figure_eight": 1661, "small_room": 414, "tof_grid": 330, "tof_turns": 100,
}  # fmt: skip
LOOPS = (
    "workshop_rig", "workshop_handheld", "conference", "two_rooms", "figure_eight", "five_rooms", "small_room", "demo",
)  # fmt: skip
LENGTHS = {"five_rooms": (65, 75), "figure_eight": (28, 40), "sweep": (0, 0.2)}
NAMES = sorted(p.stem for p in FOLDER.glob("*.yaml"))


def positions(scenario: Scenario, agent: int = 0) -> FloatArray:
    path = seen_path(scenario.path(agent))  # within the storey: a lift passes through its ceiling
    return np.array([path.pose(k / scenario.rate)[:3, 3] for k in range(scenario.frames)])


def clearance(points: FloatArray, surfaces: list[Rectangle]) -> float:
    """Least distance (m) of the points to any surface."""
    least = np.inf
    for s in surfaces:
        d = points - s.origin
        u = np.clip(d @ s.edge_u / (s.edge_u @ s.edge_u), 0, 1)[:, None]
        v = np.clip(d @ s.edge_v / (s.edge_v @ s.edge_v), 0, 1)[:, None]
        least = min(least, float(np.linalg.norm(d - u * s.edge_u - v * s.edge_v, axis=1).min()))
    return least


def test_all_scenarios_are_there() -> None:
    wanted = {
        "workshop_rig", "workshop_handheld", "fireman_10hz", "fireman_5hz", "sweep", "conference", "two_rooms",
        "figure_eight", "five_rooms", "tof_grid", "tof_turns", "small_room", "firemen_2", "firemen_3", "fifty_rooms",
    }  # fmt: skip
    assert wanted <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_paths_keep_clear_of_everything(name: str) -> None:
    scenario = Scenario.load(FOLDER / f"{name}.yaml")
    surfaces = scenario.world().surfaces
    for agent in range(len(scenario.agents)):
        assert clearance(positions(scenario, agent)[::3], surfaces) > 0.25


@pytest.mark.parametrize("name", LOOPS)
def test_loops_return_to_their_start(name: str) -> None:
    path = Scenario.load(FOLDER / f"{name}.yaml").path()
    np.testing.assert_allclose(path.pose(path.duration), path.pose(0.0), atol=1e-9)


@pytest.mark.parametrize("name", FRAMES)
def test_number_of_frames_is_the_experiments(name: str) -> None:
    assert Scenario.load(FOLDER / f"{name}.yaml").frames == FRAMES[name]


@pytest.mark.parametrize("name", LENGTHS)
def test_length_of_the_path_is_the_experiments(name: str) -> None:
    steps = np.diff(positions(Scenario.load(FOLDER / f"{name}.yaml")), axis=0)
    shortest, longest = LENGTHS[name]
    assert shortest <= np.linalg.norm(steps, axis=1).sum() <= longest


def test_figure_eight_covers_82_square_metres() -> None:
    rooms = Scenario.load(FOLDER / "figure_eight.yaml").rooms
    area = sum((r.x[1] - r.x[0]) * (r.y[1] - r.y[0]) for r in rooms)
    assert area == pytest.approx(82, abs=0.5)


def test_sweep_turns_by_a_right_angle() -> None:
    path = Scenario.load(FOLDER / "sweep.yaml").path()
    forward = path.pose(path.duration)[:3, 0]
    np.testing.assert_allclose(forward, [0, 1, 0], atol=1e-9)


def test_five_and_ten_hertz_are_the_same_motion() -> None:
    ten, five = (Scenario.load(FOLDER / f"fireman_{f}hz.yaml") for f in (10, 5))
    np.testing.assert_allclose(positions(ten)[::2], positions(five), atol=1e-9)


def test_grid_has_twenty_poses_and_two_turns_of_fifteen_scans() -> None:
    scenario = Scenario.load(FOLDER / "tof_grid.yaml")
    poses = np.round([scenario.path().pose(k / scenario.rate)[:2, :].ravel() for k in range(scenario.frames)], 6)
    different, counts = np.unique(poses, axis=0, return_counts=True)
    assert len(different) == 22
    assert (counts == 15).all()


def test_shortened_scenario_keeps_its_motion() -> None:
    whole = Scenario.load(FOLDER / "small_room.yaml")
    np.testing.assert_array_equal(positions(whole.shortened(20)), positions(whole)[:20])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"frames": 0}, "frames"),
        ({"sensors": ["radar"]}, "radar"),
        ({"rooms": [{"name": "x", "x": [0, 5], "y": [0, 5], "style": "castle"}]}, "castle"),
        ({"agents": [{"motion": "flying", "path": [[1, 1], [2, 2]]}]}, "flying"),
        ({"agents": [{"motion": "rig", "path": [[1, 1]]}]}, "way points"),
        ({"agents": [{"motion": "rig", "path": [[1, 1], [2, "two"]]}]}, "a way point is"),
        ({"agents": [{"motion": "rig", "path": [[1, 1], [9, 2]]}]}, r"leaves all rooms at \(9, 2\)"),
        ({"agents": [{"motion": "rig", "speed": 3, "path": [[1, 1], [2, 2]]}]}, "speed"),
        ({"stereo": {"baselime": 0.1}}, "baseline"),
        ({"objects": [{"kind": "piano", "at": [1, 1]}]}, "piano"),
        ({"objects": [{"kind": "table", "at": [50, 1]}]}, "no room"),
    ],
)
def test_bad_scenarios_are_refused(scenario: Scenario, change: dict[str, object], word: str) -> None:
    values = {
        "seed": 1,
        "rate": 10.0,
        "frames": 5,
        "rooms": [{"name": "x", "x": [0, 5], "y": [0, 5]}],
        "agents": [{"motion": "rig", "path": [[1, 1], [2, 2]]}],
        **change,
    }
    with pytest.raises(ValueError, match=word):
        Scenario.from_mapping("bad", values).world()


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match="small_room"):
        Scenario.load("smal_room")
