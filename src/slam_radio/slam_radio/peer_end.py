# SPDX-License-Identifier: Apache-2.0
"""The end of a link of an agent among others, without a post."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import replace
from functools import partial

from slam_core.health import State
from slam_core.messages import SUBMAP_TOPICS, estimate_from_message, submap_from_messages
from slam_core.messages.base import Message
from slam_core.messages.submaps import SubmapMessages
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.types import Submap
from slam_radio.downlink import Downlink
from slam_radio.link_end import End, LinkNode
from slam_radio.link_ends import DetailRequests, SubmapPublisher, submap_key
from slam_radio.link_state import LinkState
from slam_radio.packing.light_submap import pack
from slam_radio.queues.byte_budget import ByteBudget
from slam_radio.queues.detail_sender import DetailSender
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.inbox import Inbox
from slam_radio.queues.outbox import Outbox
from slam_radio.uplink import Uplink, UplinkTurns
from slam_radio.wire.index_ranges import Key
from slam_radio.wire.radio_messages import pack_pose, pack_submap, unpack_acknowledgement, unpack_pose, unpack_want

_DISK_PAUSE_S = 10.0
"""Own details that a full disk does not take are tried again after so long."""


class PeerEnd(End):
    """An agent among others: a link to each of them, and all submaps published as a post would have them.

    Its own go the same way as the others', through the bytes that are sent: whoever joins them has what a post has.
    So do details: those of the others are asked for, its own, by which they are joined too, are packed for itself.
    """

    def __init__(self, node: LinkNode) -> None:
        super().__init__(node)
        config = node.config
        self.name, *others = config.agents
        budget = ByteBudget(config.bytes_per_second)
        self.own = Inbox(self.name, node.state_folder / "inbox" / self.name)
        self.store = DetailStore(node.state_folder / "details" / self.name, 1e6 * config.whole_megabytes)
        self.uplinks = {
            other: Uplink(
                Outbox(node.state_folder / "outbox" / other), budget, config.resend_after_s, config.silent_after_s,
                DetailSender(self.store, config.bytes_per_second, config.resend_after_s),
            )
            for other in others
        }  # fmt: skip
        self.turns = UplinkTurns(self.uplinks)
        for key, light in self.own.kept():  # for who is new since, or could not be written for
            for uplink in self._lacking(key):
                uplink.outbox.add(key, light)
        inboxes = [Inbox(other, node.state_folder / "inbox" / other) for other in others]
        self.downlink = Downlink(inboxes, budget, config.silent_after_s)
        self.publisher = SubmapPublisher(node, config.agents)
        DetailRequests(node, (self.own, *inboxes))
        self._own_details_due_s = float("-inf")
        for inbox in (self.own, *inboxes):
            self.tell_strangers(inbox.strangers, "passed on")
        self.tell_strangers(self.store.strangers, "sent")
        for uplink in self.uplinks.values():
            self.tell_strangers(uplink.outbox.strangers, "sent")
        self._pose: bytes | None = None
        source = f"{config.source}/" if config.source else ""
        own_topics = {f"{source}{topic}": kind for topic, kind in SUBMAP_TOPICS.items()}
        node.listen_together(own_topics, self.on_own_submap, latched=True, required=False, stamps=StampPolicy.ANY)
        node.listen(f"{source}odom", "Odometry", self.on_own_odometry, required=False, stamps=StampPolicy.ANY)
        for other in others:
            hears, sends = f"slam/{other}/to/{self.name}", f"slam/{self.name}/to/{other}"
            self.hear(f"{hears}/pose", partial(self.on_pose, other))
            self.hear(f"{hears}/submap/*/*", partial(self.on_submap, other))
            self.hear(f"{hears}/details/*/*", partial(self.on_details, other))
            self.hear(f"{hears}/none", partial(self.on_none, other))
            self.hear(f"{hears}/backlog", partial(self.on_backlog, other))
            self.hear(f"{sends}/ack", partial(self.on_acknowledgement, other))
            self.hear(f"{sends}/want", partial(self.on_want, other))

    def on_own_submap(self, *messages: Message) -> None:
        """Pack a finished submap, pass it on as the others will have it, and keep it until all have it."""
        submap = replace(submap_from_messages(SubmapMessages(*messages)), agent=self.name)
        key, now = (submap.session, submap.index), time.monotonic()
        lacking = self._lacking(key)
        is_new = key not in self.own.received
        if not (lacking or is_new):
            self.node.health.count("submaps sent again")
            return
        light = pack(submap, self.node.config.light)
        try:
            if is_new:  # first: what cannot be unpacked here is for no other either
                self.publisher.pass_on(self.name, self.own.take(key, pack_submap(submap.index, light)))
                self.keep_details(self.store, key, submap, light)
            for uplink in lacking:
                uplink.add_submap(key, light, now)
        except OSError as error:
            raise ValueError(f"submap {submap.index} cannot be kept for the others: {error}") from error
        self.node.health.count("submaps packed")

    def _lacking(self, key: Key) -> list[Uplink]:
        """Links to those for whom an own submap is neither kept nor done."""
        return [uplink for uplink in self.uplinks.values() if not uplink.outbox.knows(key)]

    def on_own_odometry(self, message: Message) -> None:
        """Keep the newest pose, as it is sent, for those to whom one is due."""
        now = time.monotonic()
        due = [uplink for uplink in self.uplinks.values() if uplink.pose_is_due(now)]
        if not due:
            return
        data = pack_pose(estimate_from_message(message))
        for uplink in due:
            uplink.set_pose(data)
        self._pose = data

    def on_pose(self, other: str, _: str, data: bytes) -> None:
        """Publish another agent's odometry."""
        self.publisher.pass_on_pose(other, self.downlink.on_pose(other, data, time.monotonic()))

    def on_submap(self, other: str, name: str, data: bytes) -> None:
        """Keep another agent's submap and publish what is in order."""
        submaps = self.downlink.on_submap(other, submap_key(name), data, time.monotonic())
        self.publisher.pass_on(other, submaps)

    def on_details(self, other: str, name: str, data: bytes) -> None:
        """Keep details of another agent's submap and publish the submap once more, with them."""
        submaps = self.downlink.on_details(other, submap_key(name), data, time.monotonic())
        self.publisher.pass_on(other, submaps)
        self.node.health.count("details received")

    def on_none(self, other: str, _: str, data: bytes) -> None:
        """Another agent cannot tell some details: they are not asked for again, but with all others."""
        if count := self.downlink.on_none(other, data, time.monotonic()):
            self.node.health.count("details that agents cannot tell", count)

    def on_want(self, other: str, _: str, data: bytes) -> None:
        """Another agent lacks the details of some own submaps."""
        uplink = self.uplinks[other]
        assert uplink.details is not None
        uplink.details.want(unpack_want(data))
        uplink.on_heard(time.monotonic())

    def on_backlog(self, other: str, _: str, data: bytes) -> None:
        """Keep what waits at another agent."""
        self.downlink.on_backlog(other, data, time.monotonic())

    def on_acknowledgement(self, other: str, _: str, data: bytes) -> None:
        """Another agent is there and has some submaps."""
        self.uplinks[other].on_acknowledgement(unpack_acknowledgement(data), time.monotonic())

    def pump(self, now_s: float) -> None:
        """Send what is due, and publish the own pose as often."""
        self.publisher.pass_on_again((self.own, *self.downlink.inboxes))
        if self._pose is not None:
            self.publisher.pass_on_pose(self.name, unpack_pose(self._pose))
            self._pose = None
        self._take_own_details(now_s)
        for told in self.downlink.due(now_s):
            self.send(f"slam/{told.agent}/to/{self.name}/{told.kind}", told.data, urgent=True)
        for other, message in self.turns.due(now_s):
            self.send(f"slam/{self.name}/to/{other}/{message.path}", message.data, urgent=message.kind == "pose")

    def _take_own_details(self, now_s: float) -> None:
        """Publish an own submap of which the map wants details once more, with those that the others would get."""
        if not self.own.wanted or now_s < self._own_details_due_s:
            return
        key = min(self.own.wanted)
        try:
            self.publisher.pass_on(self.name, self._with_own_details(key))
        except OSError as error:  # a full disk
            self._own_details_due_s = now_s + _DISK_PAUSE_S
            self.node.health.count("not_written")
            self.node.get_logger().warning(f"details of own submap {key[1]} cannot be written: {error}")

    def _with_own_details(self, key: Key) -> list[Submap]:
        data = self.store.read(key) if self.store.pack(key) else None
        if data is not None:
            with suppress(ValueError):  # of a message of before, which said less or more
                return self.own.take_details(key, data)
        self.own.give_up([(*key, key[1] + 1)])
        self.node.health.count("details that agents cannot tell")
        return []

    def state(self, now_s: float) -> LinkState:
        """Silent agents, links that carry too little either way, and the backlog of all links together."""
        self.publisher.show(self.downlink, now_s)
        waiting = {other: uplink.backlog(now_s) for other, uplink in self.uplinks.items()}
        size, seconds = sum(b.size for b in waiting.values()), sum(b.seconds for b in waiting.values())
        self.node.health.take({
            "submaps waiting": sum(b.submaps for b in waiting.values()),
            "resent": sum(uplink.resent for uplink in self.uplinks.values()),
            "details wanted": sum(len(inbox.wanted) for inbox in (self.own, *self.downlink.inboxes)),
            "details sent": sum(uplink.details.sent for uplink in self.uplinks.values() if uplink.details is not None),
            "details that cannot be told": self.store.damaged,
        })  # fmt: skip
        heard = self.downlink.state(now_s)
        faults = [heard.reason] if heard.state is not State.OK else []
        faults += [
            f"more comes in for {other} ({b.came:.0f} bytes/s) than the link carries ({b.carried:.0f})"
            for other, b in waiting.items()
            if b.is_too_much
        ]
        return LinkState(State.DEGRADED if faults else State.OK, "; ".join(faults) or heard.reason, size, seconds)

    def reset(self) -> None:
        """Forget what has come; it is not sent again."""
        for inbox in (self.own, *self.downlink.inboxes):
            inbox.forget()

    def close(self) -> None:
        """Keep what has come, and what waits, for the next start."""
        for inbox in (self.own, *self.downlink.inboxes):
            inbox.close()
        for uplink in self.uplinks.values():
            uplink.outbox.close()
        self.store.close()
