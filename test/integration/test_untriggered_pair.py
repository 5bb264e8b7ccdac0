# SPDX-License-Identifier: Apache-2.0
"""A walk with a pair without a trigger, its right image 8 ms late: by a run, ``calibrate refine`` and real nodes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mapping import mapped, without_dense_model
from slam_bags.reading.rig_calibration import read_rig_calibration
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.cli import slam
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.online_run import run_nodes
from slam_bringup.processes.recorded_run import collect
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_viewer.results import summarise

FRAMES = 60
CHOSEN = ("stereo", "sjsam", "none")
SMALL = {"width": 320, "height": 240, "focal_length": 141.5, "raw_focal_length": 166.0}


def bag_of(folder: Path, late_ms: float) -> Path:
    scenario = Scenario.load("untriggered_pair").shortened(FRAMES)
    stereo = replace(scenario.suite.stereo, right_late_ms=late_ms, **SMALL)
    bag = folder / f"late_{late_ms:.0f}"
    write_bag(replace(scenario, suite=replace(scenario.suite, stereo=stereo)), bag, BagOptions(images="jpeg"))
    return bag


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bag_of(tmp_path_factory.mktemp("pairs"), 8.0)


@pytest.mark.slow
def test_the_offset_is_learnt_told_and_corrected(late: Path, tmp_path: Path) -> None:
    learning = summarise(mapped(late))
    assert learning["rectification"]["right_image_late_ms"] == pytest.approx(8.0, abs=1.0)
    assert any("the right image is taken 8" in event for event in learning["events"])
    off = tmp_path / "off.yaml"
    off.write_text("feature_extractor: {pair: {sigma_time_offset: 0.0}}\n")
    without = summarise(run_bag(late, without_dense_model(choose(load_system_config(off), *CHOSEN)))[0])
    assert learning["ate_rmse_m"] < 0.5 * without["ate_rmse_m"]


@pytest.mark.slow
def test_refine_writes_it_and_the_next_run_knows_it(late: Path, tmp_path: Path) -> None:
    slam(["calibrate", "refine", str(late), "-o", str(tmp_path / "rig")], standalone_mode=False)
    pair = load_system_config(None, None, read_rig_calibration([tmp_path / "rig"]).parameters).feature_extractor.pair
    assert pair.time_offset == pytest.approx(0.008, abs=1e-3)
    assert 1e-4 < pair.sigma_time_offset < 1e-3
    out = tmp_path / "known"
    slam(["run", str(late), "-o", str(out), "-q", "--calibration", str(tmp_path / "rig")], standalone_mode=False)
    known = json.loads((out / "summary.json").read_text())
    together = summarise(mapped(bag_of(tmp_path, 0.0)))
    assert not any("the right image is taken" in event for event in together["events"])
    assert known["ate_rmse_m"] < 2.0 * together["ate_rmse_m"]


@pytest.mark.slow
def test_the_nodes_tell_the_same(domain_environment: dict[str, str], late: Path, tmp_path: Path) -> None:
    config = without_dense_model(choose(load_system_config(None), *CHOSEN))
    run = run_nodes(late, config, tmp_path / "nodes", odometry=False, composed=True, names=BagNames())
    online, _ = collect(late, config, run, mapper="sjsam", odometry="none", names=BagNames())
    offline, _ = run_bag(late, config)
    told, expected = (summarise(result)["rectification"]["right_image_late_ms"] for result in (online, offline))
    assert told == pytest.approx(expected, abs=0.2)
    assert any("the right image is taken" in event for event in summarise(online)["events"])
