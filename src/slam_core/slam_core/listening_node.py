# SPDX-License-Identifier: Apache-2.0
"""A node's subscriptions: quality of service as the publishers offer it, and who is silent and why."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from slam_core.exchange import Exchange
from slam_core.guarded_node import GuardedNode
from slam_core.input_config import InputConfig
from slam_core.job_queue import JobQueue, QueuedCall
from slam_core.messages.base import Message
from slam_core.ros import declare_config, incompatibility, sensor_qos
from slam_core.stamp_gaps import StampGaps
from slam_core.stamp_guard import StampPolicy

WATCHDOG_S = 5.0
QUIET_S = 1.0
"""An input that has been quiet for so long may be subscribed to anew without losing anything."""

LATCHED_DEPTH = 1000


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
    gaps: StampGaps = field(default_factory=StampGaps)

    @property
    def has_publisher(self) -> bool:
        """True if anybody publishes the topic; what comes from this process has no subscription."""
        return self.subscription is None or bool(self.subscription.get_publisher_count())


class ListeningNode(GuardedNode):
    """Keeps the subscriptions; what arrives goes to :meth:`_receive`, which makes jobs for :meth:`work` of it."""

    def __init__(self, name: str) -> None:
        self._exchange = Exchange.current
        options = {} if self._exchange is None else self._exchange.node_options
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        self.input_config = declare_config(self, InputConfig, "input.")
        self._inputs: dict[str, Input] = {}
        self._jobs = JobQueue(self.input_config.policy, self.input_config.waiting)
        self._inbox: deque[tuple[Input, Message]] = deque()
        self._wake = self.create_guard_condition(self._guarded("inbox", self._empty_inbox))
        self._started_at_s = time.monotonic()

    def _receive(self, entry: Input, message: Message) -> None:
        raise NotImplementedError

    @property
    def has_work(self) -> bool:
        """True if a job waits."""
        return len(self._jobs) > 0

    def work(self) -> bool:
        """Do the next job that waits; False if there is none."""
        return self._jobs.run_one()

    def finish_work(self) -> None:
        """Do all jobs that wait."""
        while self.work():
            pass

    def do_later(self, source: str, run: Callable[[], None]) -> None:
        """Have something done in the node's own thread, in its turn; may be called from any thread."""
        self._jobs.add(QueuedCall(source, self._guarded(source, run)))
        self._wake.trigger()

    def _connect(self, entry: Input) -> None:
        """Listen to a node of this process where one publishes the topic, else to the network."""
        if self._exchange is None or not self._exchange.has_publisher(entry.topic):
            self._subscribe(entry)
            return
        self._exchange.listen(entry.topic, lambda message: self._put_in_inbox(entry, message))

    def _put_in_inbox(self, entry: Input, message: Message) -> None:
        """Take a message from the thread of the node that made it."""
        self._inbox.append((entry, message))
        self._wake.trigger()

    def _empty_inbox(self) -> None:
        while self._inbox:
            self._receive(*self._inbox.popleft())

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

    def do_without(self, topic: str) -> None:
        """Another input has taken the place of a required one: its silence is no fault."""
        self._inputs[topic].required = False

    def ask_again(self, topics: Iterable[str]) -> None:
        """Have latched topics sent again, as far as their publishers still keep what they sent."""
        for entry in (self._inputs[topic] for topic in topics):
            if entry.subscription is not None:
                self._subscribe(entry)

    def _unconnected(self) -> list[str]:
        """Required topics that no publisher has been matched with."""
        inputs = self._inputs.values()
        return [entry.topic for entry in inputs if entry.required and not entry.has_publisher]

    def _silence(self) -> str:
        """Names of required topics that have been silent for five seconds, with the reason, or ""."""
        now, texts = time.monotonic(), []
        for entry in self._inputs.values():
            if entry.required and not self._paused and now - (entry.seen_at_s or self._started_at_s) > WATCHDOG_S:
                texts.append(f"no input on {entry.topic} for {WATCHDOG_S:.0f} s ({self._publishers_text(entry)})")
        return "; ".join(texts)

    def _publishers_text(self, entry: Input) -> str:
        if entry.subscription is None:
            return "published in this process"
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
            from_network = entry.subscription is not None
            publishers = self.get_publishers_info_by_topic(entry.topic) if quiet and from_network else []
            if not publishers:
                continue
            best_effort = all(p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for p in publishers)
            volatile = all(p.qos_profile.durability == DurabilityPolicy.VOLATILE for p in publishers)
            if (best_effort, volatile and entry.latched) != (entry.best_effort, entry.volatile):
                entry.best_effort, entry.volatile = best_effort, volatile and entry.latched
                self._subscribe(entry)
