# SPDX-License-Identifier: Apache-2.0
"""``slam simulate``: topics, times, calibration and truth of a simulated bag, and the same bytes every time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slam_bags.reading.readings import DepthReading, PoseReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagReader
from slam_bags.storage.bag_calibration import calibration_file
from slam_bringup.pipeline.configuration import load_system_config
from slam_core.config import from_mapping
from slam_core.messages import image_from_message
from slam_experiments.commands.simulate import command
from slam_experiments.simulated.simulated_bag import BagOptions, write_bag
from slam_simulation import Scenario, Simulator
from slam_simulation.scenario import SensorSuite

ROOM = {
    "seed": 4,
    "rate": 5.0,
    "frames": 3,
    "rooms": [{"name": "office", "x": [0, 4], "y": [0, 4]}],
    "stereo": {"width": 160, "height": 120, "focal_length": 70.0, "raw_focal_length": 83.0},
    "tof": {"size": 48, "focal_length": 66.0},
    "agents": [
        {"name": "one", "motion": "helmet", "path": [[1, 1], [2, 1.2]]},
        {"name": "two", "motion": "rig", "start_s": 0.1, "path": [[2, 2], [3, 2.5]]},
    ],
}


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.from_mapping("room", ROOM)


@pytest.fixture(scope="module")
def bag(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "room"
    write_bag(scenario, path, BagOptions(truth=True), threads=1)
    return path


def test_each_agent_has_all_topics_of_the_drivers(bag: Path) -> None:
    wanted = {
        "stereo/left/image_raw", "stereo/left/camera_info", "stereo/right/image_raw", "stereo/right/camera_info",
        "tof/range/image_raw", "tof/amplitude/image_raw", "tof/intensity/image_raw", "tof/camera_info", "imu",
        "ground_truth/pose", "ground_truth/depth",
    }  # fmt: skip
    with BagReader(bag) as reader:
        topics = set(reader.topics)
        assert reader.topics["/tf_static"].latched
    assert topics == {f"/{agent}/{name}" for agent in ("one", "two") for name in wanted} | {"/tf", "/tf_static"}


def test_the_bag_holds_what_was_simulated(bag: Path, scenario: Scenario) -> None:
    simulator = Simulator(scenario, 1, threads=1)
    with SensorBag(bag) as source:
        sensors = source.sensors["two"]
        readings = [r for r in source.readings() if getattr(r, "agent", "") == "two"]
        pairs = [r for r in readings if isinstance(r, StereoReading)]
        scans = [r for r in readings if isinstance(r, DepthReading)]
        truth = source.ground_truth("two")
        assert not source.left_out
    assert truth is not None
    frames = list(simulator.run())
    assert [p.stamp_ns for p in pairs] == [f.stamp_ns for f in frames] == truth.stamps_ns.tolist()
    for frame, pair, scan, pose in zip(frames, pairs, scans, truth.poses, strict=True):
        assert frame.tof is not None
        assert np.array_equal(pair.pair.left, frame.left)
        assert np.array_equal(pair.pair.right, frame.right)
        assert np.array_equal(scan.raw.image, frame.tof.range)
        np.testing.assert_allclose(pose, frame.T_world_rig, atol=1e-12)
    np.testing.assert_allclose(sensors.transform("left", "tof"), simulator.T_left_tof, atol=1e-12)
    assert sensors.right is not None
    assert sensors.right.baseline == pytest.approx(0.12)


def test_same_scenario_same_bytes_on_one_and_two_threads(bag: Path, scenario: Scenario, tmp_path: Path) -> None:
    write_bag(scenario, tmp_path / "room", BagOptions(truth=True), threads=2)
    assert (tmp_path / "room" / "room.mcap").read_bytes() == (bag / "room.mcap").read_bytes()


def test_another_seed_gives_other_bytes(bag: Path, scenario: Scenario, tmp_path: Path) -> None:
    write_bag(replace(scenario, seed=5), tmp_path / "room", BagOptions(truth=True), threads=1)
    assert (tmp_path / "room" / "room.mcap").read_bytes() != (bag / "room.mcap").read_bytes()


def test_compact_bag_loses_less_than_the_noise(bag: Path, scenario: Scenario, tmp_path: Path) -> None:
    write_bag(scenario, tmp_path / "small", BagOptions(images="png", compact=True), threads=1)
    with SensorBag(bag) as full, SensorBag(tmp_path / "small") as small:
        pairs = [[r for r in s.readings() if isinstance(r, StereoReading)] for s in (full, small)]
        scans = [[r for r in s.readings() if isinstance(r, DepthReading)] for s in (full, small)]
    assert len(pairs[0]) == len(pairs[1]) == 6
    assert all(np.array_equal(a.pair.left, b.pair.left) for a, b in zip(*pairs, strict=True))
    difference = [a.raw.image - b.raw.image * 1e-3 for a, b in zip(*scans, strict=True)]
    assert np.abs(difference).max() < 0.00051


def test_dropped_frames_and_jitter_reach_the_bag(scenario: Scenario, tmp_path: Path) -> None:
    overrides = {"stereo": {**ROOM["stereo"], "drop_probability": 0.5, "stamp_jitter_us": 50.0}}  # type: ignore[dict-item]
    faulty = replace(scenario, suite=from_mapping(SensorSuite, {**overrides, "tof": ROOM["tof"]}))
    write_bag(faulty, tmp_path / "faulty", threads=1)
    with BagReader(tmp_path / "faulty") as reader:
        left, right = (
            [m for t, _, m in reader.messages() if t == f"/one/stereo/{s}/image_raw"] for s in ("left", "right")
        )
        assert 0 < len(left) + reader.topics["/two/stereo/left/image_raw"].count < 6
    stamps = [(a.header.stamp.nanosec - b.header.stamp.nanosec) for a, b in zip(left, right, strict=True)]
    assert all(0 < abs(s) < 500_000 for s in stamps)


def test_rectified_images_need_no_rectification(scenario: Scenario, tmp_path: Path) -> None:
    write_bag(scenario, tmp_path / "rect", BagOptions(rectified=True), threads=1)
    with SensorBag(tmp_path / "rect") as source:
        left = source.sensors["one"].left
        assert left is not None
        assert left.is_rectified
        assert source.sensors["one"].topics["left"] == "/one/stereo/left/image_rect"


def test_a_calibration_that_errs_says_so_beside_the_bag(tmp_path: Path) -> None:
    plan = ROOM | {"frames": 1, "stereo": ROOM["stereo"] | {"calibration_pictures": 20}, "sensors": ["stereo"]}
    path = tmp_path / "room"
    for _ in range(2):  # a bag of ours is replaced together with its file
        write_bag(Scenario.from_mapping("room", plan), path, BagOptions(overwrite=True), threads=1)
    known = load_system_config(None, path)
    assert 1e-4 < known.ekf_slam.calibration.sigma_scale < 0.02
    assert known.sjsam.calibration == known.ekf_slam.calibration
    own = tmp_path / "own.yaml"
    own.write_text("sjsam: {calibration.sigma_scale: 0.1}")
    assert load_system_config(own, path).sjsam.calibration.sigma_scale == 0.1
    assert load_system_config(own, path).ekf_slam.calibration == known.ekf_slam.calibration
    calibration_file(path).write_text("mine: {}")
    with pytest.raises(ValueError, match="other files are with it"):
        write_bag(Scenario.from_mapping("room", plan), path, BagOptions(overwrite=True), threads=1)


def test_true_depth_is_stored(bag: Path) -> None:
    with BagReader(bag) as reader:
        depth = next(image_from_message(m) for t, _, m in reader.messages() if t == "/one/ground_truth/depth")
    assert depth.shape == (120, 160)
    assert (depth > 0.1).all()


def test_unknown_scenario_is_one_clear_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(command, ["no_such_place", "-o", str(tmp_path / "bag")])
    assert isinstance(result.exception, ValueError)
    assert "no_such_place" in str(result.exception)
    assert not (tmp_path / "bag").exists()


def test_a_rig_on_wheels_has_odometry_and_its_mounting(tmp_path: Path) -> None:
    room = {key: value for key, value in ROOM.items() if key != "agents"}
    driven = [{"motion": "rig", "height": 0.9, "path": [[1, 1], [3, 1.2]]}]
    scenario = Scenario.from_mapping("room", room | {"agents": driven, "sensors": ["stereo", "wheels"]})
    write_bag(scenario, tmp_path / "bag", threads=1)
    with SensorBag(tmp_path / "bag") as source:
        poses = [r.pose for r in source.readings() if isinstance(r, PoseReading)]
        assert source.sensors[""].frames.lookup("base_link", "base_footprint")[2, 3] == -0.9
    assert len(poses) == 1 + 20  # 50 Hz over two steps of 0.2 s
    assert all(pose.frame_id == "base_footprint" for pose in poses)
    assert poses[-1].covariance[0, 0] > poses[1].covariance[0, 0] > 0.0


def test_the_wheels_option_adds_them_and_changes_no_image(tmp_path: Path) -> None:
    pictures = {}
    for name, option in (("with", ["--wheels"]), ("without", [])):
        words = ["small_room", "--frames", "1", "--profile", "ideal", "-o", str(tmp_path / name), *option]
        assert CliRunner().invoke(command, words).exit_code == 0
        with BagReader(tmp_path / name) as reader:
            assert ("/odometry" in reader.topics) == (name == "with")
            pictures[name] = [data for _, _, data in reader.raw(["/stereo/left/image_raw"])]
    assert pictures["with"] == pictures["without"]
