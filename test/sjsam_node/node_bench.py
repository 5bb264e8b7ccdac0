# SPDX-License-Identifier: Apache-2.0
"""The node under test in this process, and a neighbour that talks to it over topics."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from sjsam_node.node import SjsamNode
from slam_core.messages import SUBMAP_TOPICS, submap_messages
from slam_core.ros import RosTypes, below, sensor_qos
from slam_core.types import Submap


class Bench:
    """A node under test and a neighbour that talks to it."""

    def __init__(self, node: SjsamNode) -> None:
        self.node, self.types = node, RosTypes()
        self.neighbour = rclpy.create_node("neighbour")
        self.executor = SingleThreadedExecutor()
        for member in (node, self.neighbour):
            self.executor.add_node(member)
        self.received: dict[str, list[Any]] = {}
        self.submap_publishers: dict[str, list[Any]] = {}

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

    def ask(self, name: str) -> Any:
        return self.neighbour.create_client(Trigger, f"/sjsam/{name}").call_async(Trigger.Request())

    def call(self, name: str) -> Any:
        future = self.ask(name)
        assert self.spin_until(future.done, 20.0), f"{name} does not answer"
        return future.result()

    def send(self, submaps: list[Submap]) -> None:
        for submap in submaps:
            if submap.agent not in self.submap_publishers:
                topics = {below(submap.agent, topic): kind for topic, kind in SUBMAP_TOPICS.items()}
                self.submap_publishers[submap.agent] = [self.publisher(topic, kind) for topic, kind in topics.items()]
            messages = submap_messages(self.types, submap)
            for publisher, message in zip(self.submap_publishers[submap.agent], messages, strict=True):
                publisher.publish(message)

    @property
    def counters(self) -> Counter[str]:
        return self.node.health.counters


@contextmanager
def running(*parameters: str) -> Iterator[Bench]:
    """A bench whose node has these parameters (``name:=value``); rclpy is shut down too where the node refuses them."""
    rclpy.init(args=["--ros-args", *(word for p in parameters for word in ("-p", p))])
    try:
        bench = Bench(SjsamNode())
        try:
            yield bench
        finally:
            bench.executor.shutdown()
            bench.node.destroy_node()
            bench.neighbour.destroy_node()
    finally:
        rclpy.shutdown()
