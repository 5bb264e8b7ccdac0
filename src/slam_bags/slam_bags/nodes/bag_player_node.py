# SPDX-License-Identifier: Apache-2.0
"""Node ``bag_player``: publishes a bag's messages as they are, at a rate or as fast as the nodes can follow."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from std_srvs.srv import Trigger

from slam_bags.nodes.pacing import Connections, FlowControl, ReplayClock, RequiredSubscribers, header_stamp_ns
from slam_bags.reading.extrinsics import StaticTransform
from slam_bags.storage.bag import BagReader, RawMessage
from slam_core.config import Config, parameter
from slam_core.messages import (
    STATIC_TRANSFORMS_TOPIC,
    pose7_from_message,
    pose7_message,
    stamp_ns,
    time_message,
)
from slam_core.nodes.base_node import PROGRESS_TOPIC
from slam_core.ros import RosTypes, declare_config, message_class, run_node, sensor_qos

_DEPTH = 200
_SETTLE_S = 1.0
_CLOCK_STEP_NS = 10_000_000
_PATIENCE_S = 120.0
"""Longest wait for a paced node that reports nothing, s."""


@dataclass(frozen=True)
class PlayerConfig(Config):
    """Parameters of ``bag_player``."""

    bag: str = parameter("", "bag to play: folder, .mcap or .db3")
    rate: float = parameter(1.0, "speed against the recording; 0: as fast as possible", minimum=0.0)
    loop: bool = parameter(False, "start again at the end")
    clock: bool = parameter(False, "publish /clock")
    topics: tuple[str, ...] = parameter((), "topics to play; empty: all")
    rename: tuple[str, ...] = parameter((), "'<topic of the bag>=<topic>': publish under this name")
    pace: tuple[str, ...] = parameter((), "'<node>=<topic>': do not run ahead of this node on this topic")
    window: int = parameter(4, "messages of a paced topic that may be unprocessed", minimum=1)
    wait_for_subscribers: float = parameter(3.0, "longest wait for subscribers at the start", unit="s", minimum=0.0)
    wait_for_start: bool = parameter(False, "begin when the service ~/start is called, not when subscribers are there")
    subscribers: tuple[str, ...] = parameter(
        (), "'<topic>=<number>' as published: do not begin before it has so many subscribers, or patience runs out"
    )
    transforms: tuple[str, ...] = parameter(
        (), "'<parent> <child> x y z qx qy qz qw': static transforms instead of the bag's"
    )
    nodes: tuple[str, ...] = parameter(
        (), "full names: do not begin before these nodes have all inputs connected, or patience runs out"
    )


class BagPlayerNode(Node):
    """Plays in a thread of its own; the executor's thread hears the nodes' progress."""

    def __init__(self) -> None:
        super().__init__("bag_player", automatically_declare_parameters_from_overrides=True)
        self.config = declare_config(self, PlayerConfig)
        if not self.config.bag:
            raise ValueError("parameter 'bag' must name the bag to play")
        self._types = RosTypes()
        self._flow = FlowControl(self.config.pace, self.config.window, _PATIENCE_S)
        self._required_subscribers = RequiredSubscribers(self.config.subscribers)
        self._connections = Connections()
        self._transforms = [StaticTransform.parse(text) for text in self.config.transforms]
        self._names = dict(pair.split("=", 1) for pair in self.config.rename)
        self._stop = threading.Event()
        self._start = threading.Event()
        self._sent = 0
        self._reader = BagReader(Path(self.config.bag)).__enter__()
        self._outputs = self._make_publishers()
        self._static_output = self.create_publisher(
            self._types.TransformStamped, STATIC_TRANSFORMS_TOPIC, sensor_qos(_DEPTH, latched=True)
        )
        self._clock_output = self.create_publisher(self._types.Clock, "/clock", 10) if self.config.clock else None
        self._clock_ns = 0
        self.create_subscription(self._types.Header, PROGRESS_TOPIC, self._on_progress, sensor_qos(1000))
        self.create_subscription(self._types.DiagnosticArray, "/diagnostics", self._on_diagnostics, sensor_qos(1000))
        self.create_service(Trigger, "~/start", self._on_start)
        self._thread = threading.Thread(target=self._run, name="player")
        self._thread.start()

    def on_close(self) -> None:
        """Stop playing and close the bag."""
        self._stop.set()
        self._start.set()
        self._flow.clear()
        self._thread.join(timeout=10.0)
        self._reader.__exit__()

    def _on_progress(self, header: Any) -> None:
        self._flow.progress(header.frame_id, header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            self._connections.report(status.name, {entry.key: entry.value for entry in status.values})

    def _on_start(self, _: Any, response: Any) -> Any:
        self._start.set()
        response.success = True
        return response

    def _run(self) -> None:
        try:
            self._send_static_transforms()
            if self.config.wait_for_start:
                self._start.wait()
            else:
                self._wait_for_subscribers()
            self._wait_until(lambda: self._connections.obstacles(self.config.nodes))
            self._wait_for_required_subscribers()
            self._static_output.wait_for_all_acked(Duration(seconds=5))
            self._play_once()
            while self.config.loop and not self._stop.is_set():
                self._flow.clear()
                self._play_once()
            self._finish()
        except ValueError as error:
            self.get_logger().error(str(error))
        except Exception:
            # Whoever shut the context down wants no more of the bag.
            if rclpy.ok():
                raise
        finally:
            if not self._stop.is_set():
                rclpy.try_shutdown()

    def _play_once(self) -> None:
        clock = ReplayClock(self.config.rate)
        for raw in self._reader.raw(list(self._outputs)):
            if self._stop.wait(clock.delay_s(raw.stamp_ns)):
                return
            self._send(raw)

    def _send(self, raw: RawMessage) -> None:
        topic = self._names.get(raw.topic, raw.topic)
        if topic in self._flow.topics:
            if not self._flow.wait(topic):
                self.get_logger().warning(f"no progress on {topic} for {_PATIENCE_S:.0f} s, going on")
            self._flow.sent(topic, header_stamp_ns(raw.data))
        self._send_clock(raw.stamp_ns)
        self._outputs[raw.topic].publish(raw.data)
        self._sent += 1

    def _send_clock(self, stamp: int) -> None:
        if self._clock_output is not None and abs(stamp - self._clock_ns) >= _CLOCK_STEP_NS:
            self._clock_ns = stamp
            self._clock_output.publish(self._types.Clock(clock=time_message(self._types, stamp)))

    def _finish(self) -> None:
        for publisher in self._outputs.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        # Told to stop, it hears no progress any more.
        if not self._stop.is_set() and not self._flow.drain():
            self.get_logger().warning("the nodes have not processed everything")
        self.get_logger().info(f"played {self._sent} messages")

    def _make_publishers(self) -> dict[str, Any]:
        publishers = {}
        for topic, info in self._reader.topics.items():
            if self.config.topics and topic not in self.config.topics:
                continue
            kind = message_class(info.type_name)
            if kind is not None:
                profile = sensor_qos(_DEPTH, info.latched, best_effort=info.best_effort)
                publishers[topic] = self.create_publisher(kind, self._names.get(topic, topic), profile)
            else:
                self.get_logger().warning(f"{topic} is not played: {info.type_name} is not installed")
        if not publishers:
            raise ValueError(f"{self.config.bag} holds none of the topics to play")
        return publishers

    def _send_static_transforms(self) -> None:
        """Transforms first, as ``static_transforms``: what comes later needs them."""
        own = {t.child for t in self._transforms}
        topics = [t for t in self._reader.topics if t.endswith("/tf_static")]
        for _, _, message in self._reader.messages(topics):
            for transform in message.transforms:
                t = StaticTransform(*pose7_from_message(transform))
                if t.child not in own:
                    self._send_static(t, stamp_ns(transform))
        for t in self._transforms:
            self._send_static(t, 0)

    def _send_static(self, t: StaticTransform, stamp: int) -> None:
        self._static_output.publish(pose7_message(self._types, stamp, t.parent, t.child, t.pose))

    def _wait_for_subscribers(self) -> None:
        """Until nobody new has subscribed for a second: what is sent before discovery ends is lost to latecomers."""
        deadline = time.monotonic() + self.config.wait_for_subscribers
        counts: list[int] = []
        stable_since = time.monotonic()
        while time.monotonic() < deadline and not self._stop.wait(0.05):
            now = [p.get_subscription_count() for p in (*self._outputs.values(), self._static_output)]
            if now != counts:
                counts, stable_since = now, time.monotonic()
            if any(counts) and time.monotonic() - stable_since > _SETTLE_S:
                break

    def _wait_for_required_subscribers(self) -> None:
        """Until this end knows of everybody who is to hear: discovery takes both ends their own time."""
        outputs = {self._names.get(topic, topic): publisher for topic, publisher in self._outputs.items()}
        outputs[STATIC_TRANSFORMS_TOPIC] = self._static_output
        self._required_subscribers.forget_all_but(outputs)
        missing = self._required_subscribers.missing
        self._wait_until(
            lambda: [
                f"{topic} has not all its subscribers"
                for topic in missing(lambda t: outputs[t].get_subscription_count())
            ]
        )

    def _wait_until(self, obstacles: Callable[[], list[str]]) -> None:
        """Until there are none any more, or patience runs out."""
        deadline = time.monotonic() + _PATIENCE_S
        while found := obstacles():
            if self._stop.wait(0.02):
                return
            if time.monotonic() > deadline:
                self.get_logger().warning(f"going on although {'; '.join(found)}")
                return


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(BagPlayerNode, args)


if __name__ == "__main__":
    main()
