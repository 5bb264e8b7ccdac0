# SPDX-License-Identifier: Apache-2.0
"""The node as its neighbours see it: submaps over topics in, map, path, transform and services out."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

rclpy = pytest.importorskip("rclpy")
pytestmark = pytest.mark.ros

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sjsam_node.node import SjsamNode  # noqa: E402
from slam_core.geometry import boxminus  # noqa: E402
from slam_core.messages import SUBMAP_TOPICS, path_from_message, submap_messages  # noqa: E402
from slam_core.ros import RosTypes, sensor_qos  # noqa: E402


class Bench:
    """A node under test and a neighbour that talks to it."""

    def __init__(self, node: SjsamNode) -> None:
        self.node, self.types = node, RosTypes()
        self.neighbour = rclpy.create_node("neighbour")
        self.executor = SingleThreadedExecutor()
        for member in (node, self.neighbour):
            self.executor.add_node(member)
        self.received: dict[str, list[Any]] = {}

    def listen(self, topic: str, kind: str) -> None:
        self.received[topic] = []
        self.neighbour.create_subscription(
            getattr(self.types, kind), topic, self.received[topic].append, sensor_qos(10, True)
        )

    def publisher(self, topic: str, kind: str) -> Any:
        return self.neighbour.create_publisher(getattr(self.types, kind), topic, sensor_qos(100, True))

    def spin_until(self, condition: Callable[[], bool], seconds: float = 30.0) -> bool:
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
            self.node.work()
        return condition()

    def call(self, name: str) -> Any:
        future = self.neighbour.create_client(Trigger, f"/sjsam/{name}").call_async(Trigger.Request())
        self.executor.spin_until_future_complete(future, timeout_sec=20.0)
        return future.result()


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("ROS_DOMAIN_ID", "93")
    arguments = [f"map_path:={tmp_path / 'map'}", f"ply_path:={tmp_path / 'map.ply'}"]
    rclpy.init(args=["--ros-args", *(word for a in arguments for word in ("-p", a))])
    bench = Bench(SjsamNode())
    yield bench
    bench.executor.shutdown()
    bench.node.destroy_node()
    bench.neighbour.destroy_node()
    rclpy.shutdown()


def test_submaps_in_map_out_and_services(bench: Bench, rng: np.random.Generator, tmp_path: Path) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.5), rng, "")
    submaps = agent.submaps()
    for topic, kind in (
        ("map/path", "Path"), ("map_to_odom", "TransformStamped"), ("pose", "PoseWithCovarianceStamped"),
        ("map/landmarks", "PointCloud2"), ("map/graph", "MarkerArray"), ("map/marks", "MarkerArray"),
    ):  # fmt: skip
        bench.listen(topic, kind)
    publishers = [bench.publisher(topic, kind) for topic, kind in SUBMAP_TOPICS.items()]
    for submap in submaps:
        for publisher, message in zip(publishers, submap_messages(bench.types, submap), strict=True):
            publisher.publish(message)
    assert bench.spin_until(lambda: len(bench.node.global_map.graph.records) == len(submaps))
    wanted = len(submaps) * agent.steps + 1
    assert bench.spin_until(lambda: any(len(m.poses) == wanted for m in bench.received["map/path"]))
    offline, _ = join(submaps)
    online = path_from_message(bench.received["map/path"][-1])
    for (stamp, T), pose in zip(online, offline.trajectory(""), strict=True):
        assert stamp == pose.stamp_ns
        assert np.abs(boxminus(T, pose.T)).max() < 1e-9
    published = len(bench.received["map/path"])
    assert not bench.spin_until(lambda: len(bench.received["map/path"]) > published, 1.5), "published without news"
    transform = bench.received["map_to_odom"][-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")

    assert bench.call("save_map").success
    assert (tmp_path / "map" / "manifest.json").exists()
    assert bench.call("export_ply").success
    assert (tmp_path / "map.ply").stat().st_size > 100
    assert bench.call("mark_here").success
    click = bench.publisher("clicked_point", "PointStamped")
    click.publish(bench.types.PointStamped(header=bench.types.Header(frame_id="map"), point=bench.types.Point(x=1.0)))
    assert bench.spin_until(lambda: len(bench.node.global_map.marks.marks) == 2, 5.0)
    assert bench.call("reset").success
    assert len(bench.node.global_map.graph.records) == 0
    assert bench.call("load_map").success
    assert len(bench.node.global_map.graph.records) == len(submaps)


def test_services_answer_on_an_empty_map(bench: Bench) -> None:
    assert not bench.call("load_map").success
    assert not bench.call("mark_here").success
