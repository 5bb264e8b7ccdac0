"""Odd stamps and jumping clocks at the filter and the joiner as real processes: no submap is ever forgotten."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")
pytestmark = pytest.mark.ros

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / name) for name in ("ekf_slam_node", "sjsam_node")]

from feature_world import T_RIG_OPTICAL, loop, room  # noqa: E402
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from nav_msgs.msg import Path as PathMessage  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from sjsam_node.storage import is_map  # noqa: E402
from slam_core.messages import (  # noqa: E402
    FEATURE_TOPICS,
    STATIC_TRANSFORMS_TOPIC,
    features_messages,
    transform_message,
)
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import Features  # noqa: E402

STEP_NS = 100_000_000
START = 1_700_000_000 * 10**9
HOUR = 3600 * 10**9


class Chain(Probe):
    """``ekf_slam`` and ``sjsam`` as processes, and who sends features and reads the map's path."""

    def __init__(self, context: Any, domain: int, folder: Path) -> None:
        super().__init__(context)
        self.environment = {
            **os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)
        }  # fmt: skip
        self.map_path = folder / "map"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.start("ekf_slam")
        self.start("sjsam")
        self.listen("odom", Odometry)
        self.listen("pose", PoseWithCovarianceStamped)
        self.listen("map/path", PathMessage, latched=True)
        for topic, kind in FEATURE_TOPICS.items():
            self.senders[topic] = self.node.create_publisher(getattr(self.types, kind), topic, sensor_qos(100))
        for topic, kind in (("clicked_point", PointStamped), ("initialpose", PoseWithCovarianceStamped)):
            self.senders[topic] = self.node.create_publisher(kind, topic, sensor_qos(10))
        self.mounting = self.node.create_publisher(TransformStamped, STATIC_TRANSFORMS_TOPIC, sensor_qos(10, True))
        self.rng = np.random.default_rng(4)
        self.world = room(self.rng)

    def start(self, name: str) -> None:
        module = {"ekf_slam": "ekf_slam_node", "sjsam": "sjsam_node"}[name]
        own = {
            "sjsam": (f"map_path:={self.map_path}", "autosave_period_s:=0.5", f"ply_path:={self.map_path}.ply"),
            "ekf_slam": ("submap.max_frames:=8",),
        }[name]
        arguments = [word for parameter in own for word in ("-p", parameter)]
        command = [sys.executable, "-c", f"from {module}.node import main; main()", "--ros-args", *arguments]
        self.processes[name] = subprocess.Popen(command, env=self.environment)

    def kill(self, name: str) -> None:
        self.processes[name].kill()
        self.processes[name].wait()

    def connect(self) -> None:
        self.wait(lambda: all(s.get_subscription_count() for s in self.senders.values()), "nodes do not listen")
        self.wait(lambda: self.node.get_publishers_info_by_topic("odom") != [], "no filter")
        self.mounting.publish(
            transform_message(self.types, 0, "base_link", self.features(loop(2)[0], 0).frame_id, T_RIG_OPTICAL)
        )
        self._let_others_find_us()

    def features(self, T: np.ndarray, stamp: int) -> Features:
        return self.world.features(T, stamp, self.rng)[0]

    def send_frames(self, poses: list[np.ndarray], first_ns: int) -> None:
        for k, T in enumerate(poses):
            self.send_frame(T, first_ns + k * STEP_NS)

    def send_frame(self, T: np.ndarray, stamp: int) -> None:
        for topic, message in zip(FEATURE_TOPICS, features_messages(self.types, self.features(T, stamp)), strict=True):
            self.send(topic, message)

    def wait_for_odometry(self, stamp: int) -> None:
        stamps = self.received["odom"]
        self.wait(lambda: any(stamp_of(m) == stamp for m in stamps), f"no odometry at {stamp}")

    def call(self, name: str) -> Any:
        client = self.node.create_client(Trigger, name)
        self.wait(client.service_is_ready, f"no service {name}")
        future = client.call_async(Trigger.Request())
        self.wait(future.done, f"{name} does not answer")
        return future.result()

    def wait_for_map(self, stamp: int) -> None:
        paths = self.received["map/path"]
        self.wait(lambda: any(stamp_of(p) == stamp for m in paths for p in m.poses), f"{stamp} is not in the map")

    def saved_keys(self, newest_ns: int) -> list[tuple[str, int, int]]:
        """Keys of the saved submaps, once the pose of a stamp is in the map."""
        assert self.call("/ekf_slam/finish").success
        self.wait_for_map(newest_ns)
        answer = self.call("/sjsam/save_map")
        assert answer.success, answer.message
        return [record.key for record in GlobalMap.load(self.map_path).graph.records]


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


@pytest.fixture
def chain(tmp_path: Path) -> Iterator[Chain]:
    domain = 10 + os.getpid() % 60
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    chain = Chain(context, domain, tmp_path)
    chain.connect()
    yield chain
    for process in chain.processes.values():
        process.send_signal(signal.SIGINT)
    codes = [process.wait(30) for process in chain.processes.values()]
    chain.executor.shutdown()
    chain.node.destroy_node()
    rclpy.shutdown(context=context)
    assert codes == [0, 0]


def test_odd_stamps_of_operators_and_sensors_cost_nothing_and_a_jump_begins_a_session(chain: Chain) -> None:
    poses = loop(40)
    chain.send_frames(poses[:20], START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    chain.send("clicked_point", PointStamped())
    chain.send("initialpose", PoseWithCovarianceStamped())
    chain.send_frame(poses[20], START + HOUR)
    chain.send_frame(poses[20], 0)
    chain.send_frames(poses[20:30], START + 20 * STEP_NS)
    chain.wait_for_odometry(START + 29 * STEP_NS)
    assert len(chain.received["odom"]) == 30
    chain.send_frames(poses[30:], START - HOUR)
    chain.wait_for_odometry(START - HOUR + 9 * STEP_NS)
    keys = chain.saved_keys(START - HOUR + 9 * STEP_NS)
    second = START // 10**9
    first, jumped = ([k for k in keys if k[1] == session] for session in (second, second + 1))
    assert first == [("", second, k) for k in range(len(first))]
    assert jumped == [("", second + 1, k) for k in range(len(jumped))]
    assert len(first) >= 2
    assert jumped
    assert len(first) + len(jumped) == len(keys)


def test_both_nodes_killed_and_started_again_go_on_with_the_map(chain: Chain, tmp_path: Path) -> None:
    poses, half = loop(40), 20
    chain.send_frames(poses[:half], START)
    chain.wait_for_odometry(START + (half - 1) * STEP_NS)
    assert chain.call("/ekf_slam/finish").success
    chain.wait_for_map(START + (half - 1) * STEP_NS)
    copy = tmp_path / "map.autosave"
    chain.wait(lambda: is_map(copy) and len(GlobalMap.load(copy).graph.records) >= 2, "no autosave")
    for name in ("sjsam", "ekf_slam"):
        chain.kill(name)
    before = [record.key for record in GlobalMap.load(copy).graph.records]
    chain.wait(lambda: not any(s.get_subscription_count() for s in chain.senders.values()), "the dead still listen")
    for name in ("sjsam", "ekf_slam"):
        chain.start(name)
    chain.connect()
    first = START + 100 * STEP_NS
    chain.send_frames(poses[half:], first)
    chain.wait_for_odometry(first + 19 * STEP_NS)
    keys = chain.saved_keys(first + 19 * STEP_NS)
    assert keys[: len(before)] == before
    assert len(keys) > len(before)
    assert {session for _, session, _ in keys} == {START // 10**9, first // 10**9}
    poses_in_map = [m for m in chain.received["pose"] if stamp_of(m) >= first]
    assert len(poses_in_map) == len(poses) - half
    assert all(m.header.frame_id == "map" for m in poses_in_map)
    assert all(np.linalg.eigvalsh(np.reshape(m.pose.covariance, (6, 6))).min() > 0 for m in poses_in_map)


def test_what_the_services_did_not_write_they_leave(chain: Chain) -> None:
    chain.send_frames(loop(20), START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    assert chain.call("/ekf_slam/finish").success
    chain.wait_for_map(START + 19 * STEP_NS)
    chain.map_path.mkdir()
    (chain.map_path / "photo.jpg").write_bytes(b"mine")
    for service in ("save_map", "load_map"):
        answer = chain.call(f"/sjsam/{service}")
        assert not answer.success
        assert str(chain.map_path) in answer.message
    assert [p.name for p in chain.map_path.iterdir()] == ["photo.jpg"]
    chain.map_path.with_name("map.ply").mkdir()
    assert not chain.call("/sjsam/export_ply").success
    shutil.rmtree(chain.map_path)
    assert chain.call("/sjsam/save_map").success, "the map is still there"


def test_an_emptied_map_is_shown_and_never_saved_over_another(chain: Chain) -> None:
    chain.send_frames(loop(20), START)
    chain.wait_for_odometry(START + 19 * STEP_NS)
    keys = chain.saved_keys(START + 19 * STEP_NS)
    assert keys
    assert chain.call("/sjsam/reset").success
    chain.wait(
        lambda: bool(chain.received["map/path"]) and not chain.received["map/path"][-1].poses, "the old map stays"
    )
    answer = chain.call("/sjsam/save_map")
    assert not answer.success
    assert "empty" in answer.message
    assert len(GlobalMap.load(chain.map_path).graph.records) == len(keys)
