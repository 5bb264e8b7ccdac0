"""A node's subscriptions: quality of service as the publishers offer it, and who is silent and why."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from slam_core.config import Config, parameter
from slam_core.guarded_node import GuardedNode
from slam_core.messages.base import Message
from slam_core.ros import declare_config, incompatibility, sensor_qos
from slam_core.stamp_guard import StampPolicy
from slam_core.synchronizer import PAIRING_TOLERANCE_S

WATCHDOG_S = 5.0
QUIET_S = 1.0
"""An input that has been quiet for so long may be subscribed to anew without losing anything."""

LATCHED_DEPTH = 1000


@dataclass(frozen=True)
class InputConfig(Config):
    """How a node subscribes and pairs; parameters ``input.*`` of every node."""

    reliability: str = parameter(
        "match",
        "reliability of subscriptions; match: what the publisher offers",
        choices=("match", "reliable", "best_effort"),
    )
    depth: int = parameter(200, "messages kept per topic while the node is busy", minimum=1)
    pairing_tolerance_s: float = parameter(
        PAIRING_TOLERANCE_S, "largest difference of stamps that belong together", unit="s", minimum=0.0
    )


@dataclass
class Input:
    """One subscription and what is known of its traffic; ``handler`` takes (stamp_ns, message)."""

    topic: str
    message_class: Any
    handler: Callable[[int, Message], None]
    latched: bool
    required: bool
    policy: StampPolicy = StampPolicy.FRAMES
    subscription: Any = None
    best_effort: bool = False
    volatile: bool = False
    seen_at_s: float | None = None


class ListeningNode(GuardedNode):
    """Keeps the subscriptions; what arrives goes to :meth:`_receive`."""

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.input_config = declare_config(self, InputConfig, "input.")
        self._inputs: dict[str, Input] = {}
        self._paused = False
        self._started_at_s = time.monotonic()

    def _receive(self, entry: Input, message: Message) -> None:
        raise NotImplementedError

    def _subscribe(self, entry: Input) -> None:
        if entry.subscription is not None:
            self.destroy_subscription(entry.subscription)
        depth = LATCHED_DEPTH if entry.latched else self.input_config.depth
        profile = sensor_qos(depth, entry.latched and not entry.volatile, best_effort=entry.best_effort)
        events = SubscriptionEventCallbacks(
            message_lost=lambda event: self.health.count("lost_by_transport", event.total_count_change),
            incompatible_qos=lambda event: None,
        )
        entry.subscription = self.create_subscription(
            entry.message_class, entry.topic, lambda m: self._receive(entry, m), profile, event_callbacks=events
        )

    def _unconnected(self) -> list[str]:
        """Required topics that no publisher has been matched with."""
        inputs = self._inputs.values()
        return [entry.topic for entry in inputs if entry.required and not entry.subscription.get_publisher_count()]

    def _silence(self) -> str:
        """Which required topics have been silent for five seconds and why, or "" if none has."""
        now, texts = time.monotonic(), []
        for entry in self._inputs.values():
            if entry.required and not self._paused and now - (entry.seen_at_s or self._started_at_s) > WATCHDOG_S:
                texts.append(f"no input on {entry.topic} for {WATCHDOG_S:.0f} s ({self._publishers_text(entry)})")
        return "; ".join(texts)

    def _publishers_text(self, entry: Input) -> str:
        publishers = self.get_publishers_info_by_topic(entry.topic)
        if not publishers:
            return "it has no publisher"
        wanted = entry.subscription.qos_profile
        texts = []
        for info in publishers:
            why = incompatibility(info.qos_profile, wanted)
            texts.append(
                f"{info.node_namespace.rstrip('/')}/{info.node_name}" + (f", incompatible: {why}" if why else "")
            )
        return "published by " + ", ".join(texts)

    def _match_publishers(self) -> None:
        """Subscribe again where all publishers of a quiet topic offer another quality, as ``ros2 topic echo`` would."""
        if self.input_config.reliability != "match":
            return
        quiet_since_s = time.monotonic() - QUIET_S
        for entry in self._inputs.values():
            quiet = entry.seen_at_s is None or entry.seen_at_s < quiet_since_s
            publishers = self.get_publishers_info_by_topic(entry.topic) if quiet else []
            if not publishers:
                continue
            best_effort = all(p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for p in publishers)
            volatile = all(p.qos_profile.durability == DurabilityPolicy.VOLATILE for p in publishers)
            if (best_effort, volatile and entry.latched) != (entry.best_effort, entry.volatile):
                entry.best_effort, entry.volatile = best_effort, volatile and entry.latched
                self._subscribe(entry)
