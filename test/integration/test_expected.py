# SPDX-License-Identifier: Apache-2.0
"""Scenarios keep the bounds of ``bags/expected.yaml``."""

from __future__ import annotations

from pathlib import Path

import pytest

from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_experiments.simulated.expected import expected, violations
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_viewer.results import summarise

BAGS = Path(__file__).resolve().parents[2] / "bags"


def summary_of(bag: Path, mode: str):
    result, _ = run_bag(bag, choose(load_system_config(None), mode, "sjsam", "none"))
    return summarise(result)


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
    }


@pytest.mark.slow
def test_the_demo_keeps_its_bounds():
    assert violations("demo", summary_of(BAGS / "demo", expected()["demo"]["mode"])) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sweep", "fireman_5hz"])
def test_a_rendered_scenario_keeps_its_bounds(tmp_path, name):
    write_bag(Scenario.load(name), tmp_path / "bag", BagOptions(images="jpeg", compact=True))
    assert violations(name, summary_of(tmp_path / "bag", expected()[name]["mode"])) == []


def test_what_lies_outside_is_said():
    bounds = expected()["demo"]
    agent = {"ate_rmse_m": 1e-3 * (bounds["ate_mm"] + 1.0), "end_error_m": 0.0, "anees": 100.0}
    said = violations("demo", {**agent, "events": ["12.0 s: LOST: dark"]})
    assert len(said) == 3
    assert violations("demo", {"ate_rmse_m": 0.0, "end_error_m": 0.0, "anees": 1.0, "events": []}) == []
