# SPDX-License-Identifier: Apache-2.0
"""Node ``recorder``: writes topics to a bag as they come, with the quality of service their publishers offer.

Topics are discovered while it runs. The bag is complete only when the node has ended; it is renamed to its name then.
"""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from slam_bags.nodes.pacing import header_stamp_ns
from slam_bags.nodes.recording_clock import RecordingClock, has_header, topic_name
from slam_bags.nodes.tf_recording import transform_topic, transforms_of
from slam_bags.storage.bag import LATCHED_TOPICS, BagWriter
from slam_bags.storage.bag_types import typestore
from slam_core.config import Config, parameter
from slam_core.ros import declare_config, message_class, run_node, sensor_qos

_DEPTH = 1000
_DISCOVERY_PERIOD_S = 0.2
_HIDDEN = ("/parameter_events", "/rosout", "/progress")
_OTHER_CLOCK = ("diagnostic_msgs/msg/DiagnosticArray",)
"""Types whose stamps are those of the machine, whatever the time of the sensors is."""


@dataclass(frozen=True)
class RecorderConfig(Config):
    """Parameters of ``recorder``."""

    bag: str = parameter("", "bag to write: folder or .mcap")
    topics: tuple[str, ...] = parameter((), "topics to record; empty: all but parameter events, rosout and progress")
    storage: str = parameter("mcap", "storage of the bag", choices=("mcap", "sqlite3"))
    overwrite: bool = parameter(False, "replace a bag that was recorded before")
    header_stamps: bool = parameter(False, "store header stamps as the time of messages instead of the time of arrival")


class RecorderNode(Node):
    """Subscribes to what is published and appends the bytes to the bag."""

    def __init__(self) -> None:
        super().__init__("recorder", automatically_declare_parameters_from_overrides=True)
        self.config = declare_config(self, RecorderConfig)
        if not self.config.bag:
            raise ValueError("parameter 'bag' must name the bag to write")
        try:
            self._writer = self._open()
        except OSError as error:
            raise ValueError(f"cannot write {self.config.bag}: {error}") from error
        self._stamps: RecordingClock[Callable[[int], None]] = RecordingClock()
        self._known: set[str] = set()
        self._count = 0
        self.create_timer(_DISCOVERY_PERIOD_S, self._discover, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _open(self) -> BagWriter:
        path = Path(self.config.bag).expanduser()
        return BagWriter(path, self.config.storage, overwrite=self.config.overwrite).__enter__()

    def on_close(self) -> None:
        """Complete the bag."""
        for waiting, stamp in self._stamps.rest(self.get_clock().now().nanoseconds):
            waiting(stamp)
        self._writer.__exit__(None, None, None)
        print(f"recorded {self._count} messages to {self._writer.path}", flush=True)

    def _discover(self) -> None:
        for topic, type_names in self.get_topic_names_and_types():
            wanted = topic in self.config.topics if self.config.topics else topic not in _HIDDEN
            if wanted and topic not in self._known and self.get_publishers_info_by_topic(topic):
                self._known.add(topic)
                self._record(topic, type_names[0])

    def _record(self, topic: str, type_name: str) -> None:
        kind = message_class(type_name)
        if kind is None or type_name not in typestore().fielddefs:
            self.get_logger().warning(f"{topic} is not recorded: {type_name} is not known")
            return
        offers = [p.qos_profile for p in self.get_publishers_info_by_topic(topic)]
        latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offers)
        best_effort = all(q.reliability == ReliabilityPolicy.BEST_EFFORT for q in offers)
        self._writer.declare(topic, type_name, latched=latched, best_effort=best_effort)
        profile = sensor_qos(_DEPTH, latched, best_effort=best_effort)
        callback = self._callback(topic, type_name)
        self.create_subscription(kind, topic, callback, profile, raw=True)
        self.get_logger().info(f"recording {topic}")

    def _callback(self, topic: str, type_name: str) -> Any:
        is_frame = has_header(type_name) and type_name not in _OTHER_CLOCK and topic_name(topic) not in LATCHED_TOPICS
        carried = transform_topic(topic)

        def write(data: bytes, stamp: int) -> None:
            self._writer.write_raw(topic, type_name, data, stamp)
            if carried is not None and carried not in self._known:
                message = typestore().deserialize_cdr(data, type_name)
                self._writer.write(carried, transforms_of(message), stamp)

        def on_message(data: bytes) -> None:
            self._count += 1
            if not self.config.header_stamps:
                write(data, self.get_clock().now().nanoseconds)
                return
            for waiting, stamp in self._stamps.stamped(partial(write, data), header_stamp_ns(data) if is_frame else 0):
                waiting(stamp)

        return on_message


def main(args: list[str] | None = None) -> None:
    """Entry point of the executable."""
    run_node(RecorderNode, args)


if __name__ == "__main__":
    main()
