# SPDX-License-Identifier: Apache-2.0
"""A turn before a blank wall with two stereo cameras back to back: by a run, real nodes and ``slam doctor``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping import mapped, without_dense_model
from slam_bags.reading.rig_file import read_rig_cameras
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bringup.doctor.examination import examined
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.online_run import run_nodes
from slam_bringup.processes.recorded_run import collect
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario
from slam_viewer.results import summarise

pytestmark = pytest.mark.slow

SMALL = {"width": 320, "height": 240, "focal_length": 141.5, "raw_focal_length": 166.0}
CHOSEN = ("stereo", "sjsam", "none")
FRAMES = 75
_IMAGES = "image_raw/compressed"


@pytest.fixture(scope="module")
def back_to_back(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenario = Scenario.load("back_to_back").shortened(FRAMES)
    scenario = replace(scenario, suite=replace(scenario.suite, stereo=replace(scenario.suite.stereo, **SMALL)))
    bag = tmp_path_factory.mktemp("rigs") / "back_to_back"
    write_bag(scenario, bag, BagOptions(images="jpeg"))
    return bag


@pytest.fixture(scope="module")
def rig_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """``rig.yaml`` of both cameras, and of the front one alone."""
    folder = tmp_path_factory.mktemp("files")
    lines = [
        f"  {name}: {{left: /{name}/stereo/left/{_IMAGES}, right: /{name}/stereo/right/{_IMAGES}}}"
        for name in ("front", "back")
    ]
    files = {"both": lines, "front": lines[:1]}
    for name, cameras in files.items():
        (folder / f"{name}.yaml").write_text("\n".join(["cameras:", *cameras, ""]))
    return {name: folder / f"{name}.yaml" for name in files}


def test_no_frame_is_lost_where_one_camera_sees_a_blank_wall(back_to_back: Path, rig_files: dict[str, Path]) -> None:
    summary = summarise(mapped(back_to_back))
    assert summary["frames"] == FRAMES
    assert summary["lost_share"] == {"": 0.0}
    assert summary["sensors"][""][0] == "2 cameras (back, front)"
    assert summary["ate_rmse_m"] < 0.02
    assert summary["anees"] < 2.5
    config = without_dense_model(choose(load_system_config(None), *CHOSEN, "off"))
    alone, _ = run_bag(back_to_back, config, names=BagNames(rig=read_rig_cameras(rig_files["front"])))
    assert summarise(alone)["lost_share"][""] > 0.1


def test_the_cameras_that_a_file_lists_are_those_found(back_to_back: Path, rig_files: dict[str, Path]) -> None:
    with (
        SensorBag(back_to_back) as found,
        SensorBag(back_to_back, BagNames(rig=read_rig_cameras(rig_files["both"]))) as given,
    ):
        assert found.rigs == {"": ("back", "front")}
        assert given.rigs == {"": ("front", "back")}
        for name, sensors in given.sensors.items():
            assert sensors.left_frame == found.sensors[name].left_frame == f"{name}/stereo_left_optical_frame"
        assert given.sensors["front"].topics["imu"] == found.sensors["back"].topics["imu"] == "/imu"
        assert "imu" not in given.sensors["back"].topics


@pytest.mark.ros
def test_the_nodes_map_the_same(domain_environment: dict[str, str], back_to_back: Path, tmp_path: Path) -> None:
    config = without_dense_model(choose(load_system_config(None), *CHOSEN))
    run = run_nodes(back_to_back, config, tmp_path / "nodes", odometry=False, composed=True, names=BagNames())
    online, _ = collect(back_to_back, config, run, mapper="sjsam", odometry="none", names=BagNames())
    offline, _ = run_bag(back_to_back, config)
    ours, theirs = (result.agents[0].trajectory for result in (online, offline))
    np.testing.assert_array_equal(ours.stamps_ns, theirs.stamps_ns)
    np.testing.assert_allclose(ours.poses, theirs.poses, atol=1e-9)


def test_the_doctor_names_the_cameras_and_finds_nothing_wrong(back_to_back: Path) -> None:
    found, cameras = examined(back_to_back)
    assert found == []
    assert cameras == "one rig with 2 cameras: back (stereo), front (stereo)"
