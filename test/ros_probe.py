# SPDX-License-Identifier: Apache-2.0
"""A node for tests: sends messages to a process under test and collects what comes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from slam_core.ros import RosTypes, sensor_qos

_MOMENT_S = 0.5
_PATIENCE_S = 3.0
_ASK_AGAIN_S = 5.0


class Probe:
    """``received`` holds the messages of every topic listened to, in order."""

    def __init__(self, context: Any) -> None:
        self.node = rclpy.create_node("probe", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.types = RosTypes()
        self.received: dict[str, list[Any]] = {}
        self.senders: dict[str, Any] = {}
        self._subscriptions: list[Any] = []

    def listen(self, topic: str, message_type: Any, *, latched: bool = False) -> None:
        self.received[topic] = []
        profile = sensor_qos(100, latched)
        self._subscriptions.append(
            self.node.create_subscription(message_type, topic, self.received[topic].append, profile)
        )

    def send(self, topic: str, message: Any, *, latched: bool = False) -> None:
        if topic not in self.senders:
            self.senders[topic] = self.node.create_publisher(type(message), topic, sensor_qos(100, latched))
            self.wait(lambda: self.senders[topic].get_subscription_count() > 0, f"nobody listens to {topic}")
            self._let_others_find_us()
        self.senders[topic].publish(message)

    def wait(self, condition: Callable[[], bool], why: str, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, why
            self.executor.spin_once(timeout_sec=0.05)

    def call(self, name: str, request: Any = None, service_type: Any = Trigger) -> Any:
        """Answer of a service that may be called twice: an answer to a client that is not discovered yet is lost.

        A client of its own each time, because a killed node's never answers.
        """
        client = self.node.create_client(service_type, name)
        self.wait(client.service_is_ready, f"no service {name}")
        asked, futures = time.monotonic(), []

        def answered() -> bool:
            if time.monotonic() >= asked + _ASK_AGAIN_S * len(futures):
                futures.append(client.call_async(request or service_type.Request()))
            return any(future.done() for future in futures)

        self.wait(answered, f"{name} does not answer")
        self.node.destroy_client(client)
        return next(future.result() for future in futures if future.done())

    def spin(self, seconds: float) -> None:
        """Listen for a while."""
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, "the clock stands still")

    def _let_others_find_us(self) -> None:
        """Only this side's matches can be seen; a node that has been found may need a moment more to find us, and what
        is said before is lost.
        """
        end = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end and not all(s.get_publisher_count() for s in self._subscriptions):
            self.executor.spin_once(timeout_sec=0.05)
        end = time.monotonic() + _MOMENT_S
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
