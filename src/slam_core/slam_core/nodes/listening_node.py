# SPDX-License-Identifier: Apache-2.0
"""A node's subscriptions: quality of service as the publishers offer it, and who is silent and why."""

# rclpy is annotated in part only.
# mypy: allow-untyped-calls, disable-error-code="attr-defined,union-attr,arg-type,misc"

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from slam_core.guarded_node import GuardedNode
from slam_core.messages.base import Message
from slam_core.nodes.exchange import Exchange, Listener
from slam_core.nodes.input_config import MAX_WAITING_FRAMES, InputConfig
from slam_core.nodes.job_queue import JobQueue, QueuedCall
from slam_core.nodes.stamp_gaps import StampGaps
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.ros import declare_config, incompatibility, ros_type_name, sensor_qos

WATCHDOG_S = 5.0
QUIET_S = 1.0
"""An input that has been quiet for so long may be subscribed to anew without losing anything."""

LATCHED_DEPTH = 1000


@dataclass
class Input:
    """One subscription and what is known of its traffic; ``handler`` takes (stamp_ns, message).

    ``source`` is that of the jobs made of it, ``clock`` names the clock of its stamps.
    """

    topic: str
    message_class: Any
    handler: Callable[[int, Message], None]
    latched: bool
    required: bool
    policy: StampPolicy = StampPolicy.FRAMES
    source: str = ""
    clock: str = ""
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

    MAKES_AHEAD: ClassVar[bool] = True
    """True if a frame may be made for a node of the same process that is busy; not worth it where that is quick."""

    def __init__(self, name: str) -> None:
        self._exchange = Exchange.current
        options = {} if self._exchange is None else self._exchange.node_options
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        self.input_config = declare_config(self, InputConfig, "input.")
        self._inputs: dict[str, Input] = {}
        self._jobs = JobQueue(self.input_config.policy, MAX_WAITING_FRAMES)
        self._inbox: deque[tuple[Input, Message]] = deque()
        self._topics_out: list[str] = []
        self._to_awaken: dict[Callable[[], None], None] = {}
        self._at_work = False
        self._has_ended = False
        self._wake = self.create_guard_condition(self._guarded("inbox", self._empty_inbox))
        self._started_at_s = time.monotonic()

    def _receive(self, entry: Input, message: Message) -> None:
        raise NotImplementedError

    @property
    def has_work(self) -> bool:
        """True if a job can be done, or a message of this process waits."""
        return len(self._inbox) > 0 or self._jobs.has_ready(frames=self._may_begin())

    @property
    def received_subscriptions(self) -> list[Any]:
        """Subscriptions of the inputs that come from the network."""
        return [entry.subscription for entry in self._inputs.values() if entry.subscription is not None]

    @property
    def urgent_subscriptions(self) -> list[Any]:
        """Subscriptions of the inputs that cannot wait for the next frame."""
        inputs = self._inputs.values()
        return [entry.subscription for entry in inputs if entry.subscription is not None and not self._can_wait(entry)]

    def _can_wait(self, entry: Input) -> bool:
        """True if messages of an input are early enough when they are received with the next frame: calibrations."""
        return entry.policy is StampPolicy.ANY

    def receive(self) -> None:
        """Take all messages that have come, so that the queue knows what waits and what to leave out."""
        for subscription in self.received_subscriptions:
            self._drain(subscription)
        self._empty_inbox()

    def _drain(self, subscription: Any) -> None:
        """Take messages past the executor, which for each of them would set up anew what it waits for, 0.3 ms."""
        with subscription.handle:
            for _ in range(self.input_config.depth):
                if (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is None:
                    break
                subscription.callback(taken[0])

    def work(self) -> bool:
        """Do what waits up to the next frame; False if nothing does."""
        self._at_work = True
        done = self._jobs.run_some(frames=self._may_begin())
        self._at_work = False
        self._awaken_listeners(self._to_awaken)
        self._to_awaken.clear()
        if done:
            self._tell_of_room()
        return done

    def finish_work(self) -> None:
        """Do all jobs that wait."""
        while self._jobs.run_some():
            pass

    def _may_begin(self) -> bool:
        """True if what is made of the next frame would be used: a live node leaves others out before it begins them."""
        if self._exchange is None or self.input_config.policy == "all":
            return True
        return self._exchange.has_room(self._topics_out, self.MAKES_AHEAD)

    def _tell_of_room(self, source: str = "") -> None:
        """A frame of a source is begun, or all is done: whoever makes frames for this node may have been waiting."""
        for entry in self._inputs.values():
            if self._exchange is not None and entry.subscription is None and source in ("", entry.source):
                self._exchange.tell_of_room(entry.topic)

    def do_later(self, source: str, run: Callable[[], None]) -> None:
        """Have something done in the node's own thread, in its turn; may be called from any thread."""
        self._jobs.add(QueuedCall(source, self._guarded(source, run)))
        self._awaken()

    def _offer(self, topic: str) -> None:
        """Publish a topic (full name) in this process too."""
        if self._exchange is not None:
            self._topics_out.append(topic)
            self._exchange.advertise(topic, self._look_for_room)

    def _add_entry(self, topic: str, entry: Input) -> None:
        entry.best_effort = self.input_config.reliability == "best_effort"
        self._inputs[topic] = entry
        self._connect(entry)

    def _connect(self, entry: Input) -> None:
        """Listen to a node of this process where one publishes the topic, else to the network."""
        if self._exchange is None or not self._exchange.has_publisher(entry.topic):
            self._subscribe(entry)
            return
        self._jobs.limit(entry.source, 1)  # others wait where they cost less, at the node that makes them
        is_full = partial(self._is_full, entry) if entry.policy is StampPolicy.FRAMES and not entry.latched else None
        take = partial(self._put_in_inbox, entry)
        self._exchange.listen(entry.topic, Listener(take, self._awaken, is_full))

    def _is_full(self, entry: Input, ahead: bool) -> bool:
        """True if a frame of an input waits, or, unless one is made ``ahead``, if the node has something else to do.

        Asked by the thread of the node that makes them.
        """
        waits = any(waiting is entry for waiting, _ in list(self._inbox)) or self._jobs.has_frames_of(entry.source)
        return waits or (self._at_work and not ahead)

    def _put_in_inbox(self, entry: Input, message: Message) -> None:
        """Take a message from the thread of the node that made it."""
        self._inbox.append((entry, message))

    def _awaken_listeners(self, awaken: Iterable[Callable[[], None]]) -> None:
        """Wake the nodes that messages of this one were handed to: each once, when all that belong together are made.

        Each time would cost them a look at messages that lack their partners, and this node its turn.
        """
        if self._at_work:
            self._to_awaken |= dict.fromkeys(awaken)
        else:
            for awaken_one in awaken:
                awaken_one()

    def _awaken(self) -> None:
        """Have the node's thread look for work, if it waits for messages; it looks itself before it does."""
        if self.sleeps:
            self._wake.trigger()

    def _look_for_room(self) -> None:
        """A listener has room for a frame: go on if one waits for that."""
        if self._jobs.has_ready():
            self._awaken()

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
            use_default_callbacks=False,
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
        """Names of required topics that have been silent for five seconds, with the reason, or "".

        After ``~/finish`` silence is as it should be.
        """
        if self._has_ended:
            return ""
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
        wanted, type_name = entry.subscription.qos_profile, ros_type_name(entry.message_class)
        texts = []
        for info in publishers:
            why = incompatibility(info.qos_profile, wanted)
            why = why or ("" if info.topic_type == type_name else f"a {info.topic_type}, a {type_name} is asked for")
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
