# SPDX-License-Identifier: Apache-2.0
"""Scenarios keep the bounds of ``bags/expected.yaml``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mapping import mapped
from slam_experiments.simulated.expected import expected, violations
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_viewer.results import summarise

BAGS = Path(__file__).resolve().parents[2] / "bags"


def summary_of(bag: Path, mode: str):
    return summarise(mapped(bag, mode))


def test_every_scenario_of_the_thesis_has_bounds():
    scenarios = {path.stem for path in (BAGS / "scenarios").glob("*.yaml")}
    assert set(expected()) <= scenarios
    assert scenarios - set(expected()) <= {
        "tof_grid",
        "tof_turns",
        "fifty_rooms",
        "tagged_corridor",
        "tagged_corridor_2",
        "untriggered_pair",
        "corridor_with_positions",
        "lift",
        "stairs",
        "back_to_back",
    }


@pytest.mark.slow
def test_the_demo_keeps_its_bounds(tutorial):
    summary = json.loads((tutorial / "out" / "tutorial" / "summary.json").read_text())
    assert (summary["bag"], summary["mode"]) == ("demo", expected()["demo"]["mode"])
    assert violations("demo", summary) == []


@pytest.mark.slow
@pytest.mark.parametrize(("name", "every", "frames"), [("sweep", 2, 72), ("fireman_5hz", 1, 37)])
def test_a_rendered_scenario_keeps_its_bounds(tmp_path, name, every, frames):
    """With half the frames and without a depth camera, as rendering takes most of the time.

    Smaller pictures would not do: a baseline 4 % too long is then within the bounds.
    """
    scenario = Scenario.load(name).shortened(frames)
    assert expected()[name]["mode"] == "stereo"
    scenario = replace(scenario, sensors=tuple(s for s in scenario.sensors if s != "tof"))
    write_bag(scenario, tmp_path / "bag", BagOptions(images="jpeg", compact=True, every=every))
    assert violations(name, summary_of(tmp_path / "bag", expected()[name]["mode"])) == []


def test_what_lies_outside_is_said():
    bounds = expected()["demo"]
    agent = {"ate_rmse_m": 1e-3 * (bounds["ate_mm"] + 1.0), "end_error_m": 0.0, "anees": 100.0}
    said = violations("demo", {**agent, "events": ["12.0 s: LOST: dark"]})
    assert len(said) == 3
    assert violations("demo", {"ate_rmse_m": 0.0, "end_error_m": 0.0, "anees": 1.0, "events": []}) == []
