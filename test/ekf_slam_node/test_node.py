# SPDX-License-Identifier: Apache-2.0
"""``ekf_slam`` as a real process over real topics: the poses and submaps of the offline filter, and health in words."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from ekf_slam_node.config import EkfSlamConfig  # noqa: E402
from ekf_slam_node.slam import EkfSlam  # noqa: E402
from ekf_slam_node.stage import ODOMETRY, FilterConfig, FilterStage  # noqa: E402
from feature_world import T_RIG_OPTICAL, loop, room  # noqa: E402
from ros_probe import Probe  # noqa: E402
from slam_core.frame_tree import FrameTree  # noqa: E402
from slam_core.messages import (  # noqa: E402
    FEATURE_TOPICS,
    STATIC_TRANSFORMS_TOPIC,
    SUBMAP_TOPICS,
    SubmapMessages,
    estimate_from_message,
    features_messages,
    odometry_message,
    submap_from_messages,
    transform_message,
)
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import Features, OdometryReading, PoseEstimate  # noqa: E402

pytestmark = pytest.mark.ros

STEP_NS = 100_000_000


class FeatureProbe(Probe):
    """Sends features and collects what the filter says."""

    def __init__(self, context: Any) -> None:
        super().__init__(context)
        for topic, kind in SUBMAP_TOPICS.items():
            self.listen(topic, getattr(self.types, kind), latched=True)
        self.listen("odom", Odometry)
        self.listen("landmarks", PointCloud2)
        self.listen("/diagnostics", DiagnosticArray)
        for topic, kind in FEATURE_TOPICS.items():
            self.senders[topic] = self.node.create_publisher(getattr(self.types, kind), topic, sensor_qos(100))

    def send_mounting(self, frame_id: str) -> None:
        sender = self.node.create_publisher(TransformStamped, STATIC_TRANSFORMS_TOPIC, sensor_qos(10, latched=True))
        sender.publish(transform_message(self.types, 0, "base_link", frame_id, T_RIG_OPTICAL))

    def send_features(self, features: Features) -> None:
        for topic, message in zip(FEATURE_TOPICS, features_messages(self.types, features), strict=True):
            self.send(topic, message)

    def is_heard(self) -> bool:
        return all(sender.get_subscription_count() for sender in self.senders.values())


@pytest.fixture
def probe(domain: int) -> Iterator[FeatureProbe]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = FeatureProbe(context)
    yield probe
    probe.executor.shutdown()
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def filter_process(probe: FeatureProbe) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", "from ekf_slam_node.node import main; main()", "--ros-args", "-p", "agent:=a"]
    command += ["-p", "input.policy:=all"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    process = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
    yield process
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)


def test_poses_and_submaps_are_those_of_the_offline_filter(probe: FeatureProbe, filter_process: object) -> None:
    rng = np.random.default_rng(4)
    world, poses = room(rng), loop(25)
    frames = [world.features(T, (k + 1) * STEP_NS, rng)[0] for k, T in enumerate(poses)]
    probe.wait(probe.is_heard, "the filter does not listen")
    probe.send_features(frames[0])
    probe.wait(lambda: "rejected" in _diagnostics(probe), "a frame without known mounting was not rejected")
    probe.send_mounting(frames[0].frame_id)
    frames = frames[1:]
    offline = EkfSlam(EkfSlamConfig(agent="a"), T_RIG_OPTICAL)
    expected = [offline.process(frame) for frame in frames]
    submaps = [submap for result in expected for submap in result.submaps] + list(offline.finish())
    probe.wait(lambda: _counter(probe, "rejected") >= 1, "no count")
    time.sleep(1.0)
    for frame in frames:
        probe.send_features(frame)
    probe.wait(lambda: len(probe.received["odom"]) == len(frames), "poses are missing")
    probe.wait(lambda: len(probe.received["landmarks"]) == len(frames), "landmarks are missing")
    assert probe.received["landmarks"][-1].width == len(offline.landmark_view().ids) > 0
    client = probe.node.create_client(Trigger, "/ekf_slam/finish")
    probe.wait(client.service_is_ready, "no finish service")
    client.call_async(Trigger.Request())
    sets = [probe.received[topic] for topic in SUBMAP_TOPICS]
    probe.wait(lambda: all(len(messages) == len(submaps) for messages in sets), "submaps are missing")
    for message, result in zip(probe.received["odom"], expected, strict=True):
        np.testing.assert_allclose(estimate_from_message(message).T, result.pose.T, atol=1e-12)
        np.testing.assert_array_equal(estimate_from_message(message).covariance, result.pose.covariance)
        twist = message.twist.twist
        linear, angular = (np.array([v.x, v.y, v.z]) for v in (twist.linear, twist.angular))
        np.testing.assert_allclose(np.concatenate([linear, angular]), result.twist, atol=1e-12)
        np.testing.assert_array_equal(np.reshape(message.twist.covariance, (6, 6)), result.twist_covariance)
    assert message.child_frame_id == "base_link"
    for k, submap in enumerate(submaps):
        got = submap_from_messages(SubmapMessages(*(messages[k] for messages in sets)))
        np.testing.assert_array_equal(got.covariance, submap.covariance)
        np.testing.assert_array_equal(got.landmark_ids, submap.landmark_ids)
        assert got.follows_previous == submap.follows_previous


def test_an_odometry_bridges_darkness(probe: FeatureProbe, filter_process: object) -> None:
    """Twenty dark frames of 50: the poses are those of the stage, every frame has one, and the odometry is named."""
    rng = np.random.default_rng(4)
    world, poses = room(rng), loop(60)[:50]
    frames = [world.features(T, (k + 1) * STEP_NS, rng)[0] for k, T in enumerate(poses)]
    frames[25:45] = [frame.select(np.zeros(0, dtype=np.int64)) for frame in frames[25:45]]
    own = [
        OdometryReading((k + 1) * STEP_NS, T, 1e-6 * (k + 1) * np.eye(6), np.zeros(6), np.zeros((6, 6)))
        for k, T in enumerate(poses)
    ]
    tree = FrameTree()
    tree.add("base_link", frames[0].frame_id, T_RIG_OPTICAL)
    stage, expected = FilterStage(FilterConfig(agent="a", wait_for=(ODOMETRY,)), tree), []
    probe.senders["odometry"] = probe.node.create_publisher(Odometry, "odometry", sensor_qos(100))
    probe.wait(probe.is_heard, "the filter does not listen")
    probe.send_mounting(frames[0].frame_id)
    time.sleep(1.0)
    for reading in own:  # before the frames: topics have no order among each other
        estimate, twist = PoseEstimate(reading.stamp_ns, reading.T, reading.covariance), (np.zeros(6), np.zeros((6, 6)))
        probe.send("odometry", odometry_message(probe.types, "wheels", "base_link", estimate, twist))
        stage.add_odometry(reading)
    time.sleep(1.0)
    for frame in frames:
        probe.send_features(frame)
        stage.add_features(frame)
        expected += stage.ready()
    probe.wait(lambda: len(probe.received["odom"]) == len(frames), "poses are missing")
    for message, result in zip(probe.received["odom"], expected, strict=True):
        np.testing.assert_allclose(estimate_from_message(message).T, result.estimate.pose.T, atol=1e-9)
    assert {result.estimate.reason for result in expected[25:45]} == {"no visual association, bridged by odometry"}
    error = np.linalg.inv(poses[0]) @ poses[-1] - estimate_from_message(probe.received["odom"][-1]).T
    assert np.linalg.norm(error[:3, 3]) < 0.05
    probe.wait(lambda: "odometry: way x" in _diagnostics(probe), "the odometry is not named")


def test_loss_is_on_diagnostics(probe: FeatureProbe, filter_process: object) -> None:
    rng = np.random.default_rng(5)
    world, poses = room(rng), loop(8)
    probe.wait(probe.is_heard, "the filter does not listen")
    frame_id = world.features(poses[0], 1, rng)[0].frame_id
    probe.send_mounting(frame_id)
    probe.wait(lambda: bool(probe.received["/diagnostics"]), "no diagnostics")
    time.sleep(1.0)
    for k, T in enumerate(poses):
        features, _ = world.features(T, (k + 1) * STEP_NS, rng)
        probe.send_features(features if k < 6 else features.select(np.zeros(0, dtype=np.int64)))
    probe.wait(lambda: "LOST" in _diagnostics(probe), "loss was not reported")
    assert "rolling_shutter none seen" in _diagnostics(probe)


def _diagnostics(probe: FeatureProbe) -> str:
    return " ".join(
        f"{value.key} {value.value}"
        for array in probe.received["/diagnostics"][-3:]
        for status in array.status
        for value in status.values
    )


def _counter(probe: FeatureProbe, key: str) -> int:
    values = [
        int(value.value)
        for array in probe.received["/diagnostics"]
        for status in array.status
        for value in status.values
        if value.key == key
    ]
    return max(values, default=0)
