"""A node for tests: sends messages to a process under test and collects what comes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from slam_core.ros import RosTypes, sensor_qos


class Probe:
    """``received`` holds the messages of every topic listened to, in order."""

    def __init__(self, context: Any) -> None:
        self.node = rclpy.create_node("probe", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.types = RosTypes()
        self.received: dict[str, list[Any]] = {}
        self.senders: dict[str, Any] = {}

    def listen(self, topic: str, message_type: Any, *, latched: bool = False) -> None:
        self.received[topic] = []
        profile = sensor_qos(100, latched)
        self.node.create_subscription(message_type, topic, self.received[topic].append, profile)

    def send(self, topic: str, message: Any) -> None:
        if topic not in self.senders:
            self.senders[topic] = self.node.create_publisher(type(message), topic, sensor_qos(100))
            self.wait(lambda: self.senders[topic].get_subscription_count() > 0, f"nobody listens to {topic}")
        self.senders[topic].publish(message)

    def wait(self, condition: Callable[[], bool], why: str, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, why
            self.executor.spin_once(timeout_sec=0.05)
