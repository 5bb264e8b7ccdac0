# SPDX-License-Identifier: Apache-2.0
"""A lift ride to a storey that looks the same: by a run with and without the ride handled, and by real nodes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping import without_dense_model
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.pipeline.configuration import SystemConfig, choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.online_run import run_nodes
from slam_bringup.processes.recorded_run import Recording, collect
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_viewer.results import RunResult, summarise

HEIGHT = 9.0


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("lift") / "bag"
    scenario = Scenario.load("lift").with_profile("ideal")
    write_bag(replace(scenario, sensors=(*scenario.sensors, "pressure")), bag, BagOptions(images="jpeg"))
    return bag


def config(folder: Path, text: str = "") -> SystemConfig:
    path = folder / "own.yaml"
    path.write_text(text)
    return without_dense_model(choose(load_system_config(path if text else None), "stereo", "sjsam", "none"))


def risen(result: RunResult) -> tuple[float, float]:
    """Height (m) of the last pose above the first, and its standard deviation."""
    poses = result.agents[0].trajectory
    assert poses.covariances is not None
    return float(poses.poses[-1, 2, 3] - poses.poses[0, 2, 3]), float(np.sqrt(poses.covariances[-1, 2, 2]))


@pytest.mark.slow
def test_the_new_storey_is_at_its_height_and_not_the_old_one(lift: Path, tmp_path: Path) -> None:
    result = run_bag(lift, config(tmp_path))[0]
    height, sigma = risen(result)
    told = summarise(result)
    assert abs(height - HEIGHT) < 0.3
    assert abs(height - HEIGHT) < 3.0 * sigma < 1.0
    assert told["ate_rmse_m"] < 0.08
    assert told["rejections"]["lift_rides"] == 1
    assert any("lift rides: +" in event for event in told["events"])
    assert not told["rejections"].get("frames_lost")
    without = run_bag(lift, config(tmp_path, 'ekf_slam: {ride: {use: "off"}}\n'))[0]
    assert abs(risen(without)[0] - HEIGHT) > 5.0
    assert summarise(without)["ate_rmse_m"] > 2.0


@pytest.mark.slow
def test_the_nodes_ride_as_well(domain_environment: dict[str, str], lift: Path, tmp_path: Path) -> None:
    own = config(tmp_path)
    run = run_nodes(lift, own, tmp_path / "nodes", odometry=False, composed=True, names=BagNames())
    ((first_ns, last_ns),) = Recording(run.recording).of_agent("", "").rides
    assert 8.0 < 1e-9 * (last_ns - first_ns) < 12.0
    online, _ = collect(lift, own, run, mapper="sjsam", odometry="none", names=BagNames())
    height, sigma = risen(online)
    assert abs(height - HEIGHT) < 3.0 * sigma < 1.0
