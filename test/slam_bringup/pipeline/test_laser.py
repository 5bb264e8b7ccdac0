# SPDX-License-Identifier: Apache-2.0
"""A rig with a stereo camera and a laser scanner: its scans become the odometry of a run."""

from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_bringup.processes.node_graph import plan_nodes
from slam_core.evaluation import associate
from slam_core.messages import header_message

DEMO = Path(__file__).resolve().parents[3] / "bags" / "demo"
RAYS = 360
FRAMES = 14


def walls(x: float, y: float, yaw: float) -> np.ndarray:
    """Ranges from a place in a room of 5 x 4 m with a box in a corner, rays from behind the laser, turning left."""
    angle = yaw - np.pi + 2 * np.pi / RAYS * np.arange(RAYS)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.array([[0, 0], [5, 0], [5, 3.2], [4.2, 3.2], [4.2, 4], [0, 4], [0, 0]], float)
    start, along = corners[:-1], np.diff(corners, axis=0)
    offset = start - [x, y]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = direction[:, None, 0] * along[:, 1] - direction[:, None, 1] * along[:, 0]
        distance = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / cross
        share = (offset[:, 0] * direction[:, None, 1] - offset[:, 1] * direction[:, None, 0]) / cross
    hit = (distance > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, distance, np.inf).min(axis=1)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """The start of the demo with a laser scanner in place of its ToF camera."""
    path, types, rng = tmp_path_factory.mktemp("laser") / "bag", BagTypes(), np.random.default_rng(0)
    with SensorBag(DEMO) as demo:
        truth = demo.ground_truth("")
    assert truth is not None
    pose_at = dict(zip(truth.stamps_ns[:FRAMES].tolist(), truth.poses[:FRAMES], strict=True))
    with BagReader(DEMO) as old, BagWriter(path) as new:
        for topic, stamp, message in old.messages():
            if topic.startswith("/tof"):
                continue
            if stamp <= max(pose_at) or topic == "/tf_static":
                new.write(topic, message, stamp)
            if topic == "/ground_truth/pose" and stamp in pose_at:
                T = pose_at[stamp]
                ranges = walls(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])) + 0.005 * rng.standard_normal(RAYS)
                scan = types.LaserScan(
                    header=header_message(types, stamp, "base_link"), angle_min=-np.pi, angle_max=np.pi,
                    angle_increment=2 * np.pi / RAYS, time_increment=0.0, scan_time=0.0, range_min=0.1, range_max=30.0,
                    ranges=ranges.astype(np.float32), intensities=np.zeros(0, np.float32),
                )  # fmt: skip
                new.write("/scan", scan, stamp)
    return path


def test_scans_of_a_laser_are_registered_and_used(bag):
    config = choose(load_system_config(None), "stereo", "sjsam", "ndt")
    result, _ = run_bag(bag, config, odometry="ndt")
    agent = result.agents[0]
    assert len(agent.scan_odometry) == FRAMES
    scans, truth = associate(agent.scan_odometry, agent.truth)
    way = np.linalg.inv(truth[0]) @ truth
    assert np.linalg.norm(way[-1, :3, 3]) > 1.0
    error = np.linalg.norm(scans.poses[:, :2, 3] - way[:, :2, 3], axis=1)
    assert error.max() < 0.03
    evaluation = agent.evaluation()
    assert evaluation is not None
    assert evaluation.ate.rmse < 0.01


def test_the_nodes_of_a_rig_with_a_laser_hear_its_scans(bag):
    with SensorBag(bag) as opened:
        sensors = opened.sensors
    graph = plan_nodes(choose(load_system_config(None), "stereo", "sjsam", "ndt"), sensors, True, "")
    assert "tof_driver" not in {spec.executable for spec in graph.specs}
    assert "ndt_odometry" in {spec.executable for spec in graph.specs}
    assert graph.played["/scan"] == "/scan"
    assert "/ndt_odometry=/scan" in graph.pace
    plain = plan_nodes(choose(load_system_config(None), "stereo", "sjsam", "none"), sensors, False, "")
    assert "/scan" not in plain.played
