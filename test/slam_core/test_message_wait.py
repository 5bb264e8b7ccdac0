# SPDX-License-Identifier: Apache-2.0
"""What wakes a node: frames at once, what accompanies them only if a frame waits for it; the rest is the executor's."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS")
pytestmark = pytest.mark.ros

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from slam_core import ros  # noqa: E402
from slam_core.config import Config  # noqa: E402
from slam_core.messages import header_message, imu_message, stamp_ns  # noqa: E402
from slam_core.nodes.stage_node import StageNode  # noqa: E402
from slam_core.ros import MessageWait, sensor_qos  # noqa: E402
from slam_core.types import ImuSample  # noqa: E402

START = 1_700_000_000 * 10**9
LONG_S = 20.0


class Stage:
    """Waits for nothing but what a test says."""

    oldest_waiting_ns: int | None = None

    def give_up(self) -> None:
        """Nothing waits."""


class EarNode(StageNode[Config]):
    """Hears frames and an IMU; without timers, so that nothing wakes it by itself."""

    def __init__(self) -> None:
        super().__init__("ear", Config)
        self.stage = Stage()
        self.heard: list[int] = []
        for topic, kind in (("frames", "PointCloud2"), ("imu", "Imu")):
            self.listen(topic, kind, lambda m: self.heard.append(stamp_ns(m)))
        for timer in self.timers:
            timer.cancel()
        self.sender = rclpy.create_node("sender")
        self.frames = self.sender.create_publisher(self.types.PointCloud2, "frames", sensor_qos(10))
        self.readings = self.sender.create_publisher(self.types.Imu, "imu", sensor_qos(10))

    def publish_ready(self) -> None:
        """Nothing waits."""

    def send_frame(self, stamp: int) -> None:
        self.frames.publish(self.types.PointCloud2(header=header_message(self.types, stamp, "")))

    def send_reading(self, stamp: int) -> None:
        self.readings.publish(imu_message(self.types, "imu", ImuSample(stamp, np.zeros(3), np.zeros(3))))


@pytest.fixture
def node(domain: int) -> Iterator[EarNode]:
    rclpy.init()
    node = EarNode()
    until(lambda: not {"frames", "imu"} & {t.strip("/") for t in node._unconnected()})
    until(lambda: all(p.get_subscription_count() for p in (node.frames, node.readings)))
    yield node
    node.sender.destroy_node()
    node.destroy_node()
    rclpy.shutdown()


def until(condition: Callable[[], bool]) -> None:
    """Wait for what other threads do."""
    end = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def wakes(waiting: MessageWait, timeout_s: float = 0.3) -> bool:
    """True if something wakes the node before the time is over."""
    begin = time.monotonic()
    assert not waiting.wait(timeout_s)
    return time.monotonic() < begin + 0.9 * timeout_s


def work(node: EarNode) -> None:
    node.receive()
    while node.work():
        pass


def test_readings_wake_a_node_only_if_a_frame_waits_and_none_is_lost(node: EarNode) -> None:
    waiting = MessageWait(node)
    node.send_reading(START)
    assert not wakes(waiting)
    node.send_frame(START)
    assert wakes(waiting, LONG_S)
    work(node)
    assert node.heard == [START, START]
    node.stage.oldest_waiting_ns = START
    node.send_reading(START + 1)
    assert wakes(waiting, LONG_S)
    work(node)
    assert node.heard == [START, START, START + 1]


def test_another_thread_wakes_a_node(node: EarNode) -> None:
    waiting, done = MessageWait(node), []
    node.sleeps = True
    node.do_later("here", lambda: done.append(True))
    assert wakes(waiting, LONG_S)
    work(node)
    assert done
    assert not wakes(waiting)


def test_a_new_subscription_is_waited_for(node: EarNode) -> None:
    waiting = MessageWait(node)
    assert not wakes(waiting)
    node._subscribe(node._inputs["frames"])
    until(lambda: node._inputs["frames"].has_publisher and node.frames.get_subscription_count() == 1)
    node.send_frame(START)
    assert wakes(waiting, LONG_S)
    work(node)
    assert node.heard == [START]


def test_services_and_timers_are_left_to_the_executor(node: EarNode) -> None:
    waiting, executor, ticks = MessageWait(node), SingleThreadedExecutor(), []
    executor.add_node(node)
    client: Any = node.sender.create_client(Trigger, "/ear/reset")
    until(client.service_is_ready)
    client.call_async(Trigger.Request())
    assert waiting.wait(LONG_S)
    ros._serve(node, waiting, executor)
    assert node.health.counters["resets"] == 1
    timer = node.create_timer(0.01, lambda: ticks.append(True))
    assert waiting.wait(LONG_S)
    ros._serve(node, waiting, executor)
    assert ticks
    timer.cancel()
    assert not wakes(waiting)
    executor.shutdown()


def test_an_answer_that_awaits_something_and_a_node_that_asks_others_need_the_executor(node: EarNode) -> None:
    executor, go_on = SingleThreadedExecutor(), rclpy.task.Future()
    executor.add_node(node)

    async def answer(_: Any, response: Any) -> Any:
        await go_on
        return response

    node.create_service(Trigger, "~/long", lambda request, response: answer(request, response))
    client: Any = node.sender.create_client(Trigger, "/ear/long")
    until(client.service_is_ready)
    assert not node.needs_executor
    client.call_async(Trigger.Request())
    until(lambda: executor.spin_once(timeout_sec=0.0) or node.needs_executor)
    go_on.set_result(None)
    until(lambda: executor.spin_once(timeout_sec=0.0) or not node.needs_executor)
    node.create_client(Trigger, "anything")
    assert node.needs_executor
    executor.shutdown()
