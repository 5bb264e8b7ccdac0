# SPDX-License-Identifier: Apache-2.0
"""An agent's end of a link, and a post's."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from slam_core.geometry import FloatArray
from slam_core.messages import (
    SUBMAP_TOPICS,
    estimate_from_message,
    odometry_message,
    pose_from_message,
    stamp_ns,
    submap_from_messages,
    submap_messages,
    transform_from_message,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.messages.submap_keys import submap_keys_from_message
from slam_core.messages.submaps import SubmapMessages
from slam_core.nodes.stamp_guard import StampPolicy
from slam_core.types import PoseEstimate, Submap
from slam_radio.downlink import Downlink
from slam_radio.link_end import End, LinkNode
from slam_radio.link_state import LinkState
from slam_radio.packing.light_submap import pack
from slam_radio.queues.detail_sender import DetailSender
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.inbox import Inbox
from slam_radio.queues.outbox import Outbox
from slam_radio.uplink import Uplink
from slam_radio.view_ends import AgentViews, PostViews
from slam_radio.wire.index_ranges import Key
from slam_radio.wire.radio_messages import pack_pose, unpack_acknowledgement, unpack_correction, unpack_want


class AgentEnd(End):
    """Submaps and poses out, acknowledgements and corrections in."""

    def __init__(self, node: LinkNode) -> None:
        super().__init__(node)
        config = node.config
        self.name = config.agents[0]
        outbox = Outbox(node.state_folder / "outbox" / self.name)
        self.store = DetailStore(node.state_folder / "details" / self.name, 1e6 * config.whole_megabytes)
        self.details = DetailSender(self.store, config.bytes_per_second, config.resend_after_s)
        self.views = AgentViews(self, self.name)
        self.uplink = Uplink(
            outbox, config.bytes_per_second, config.resend_after_s, config.silent_after_s, self.details,
            self.views.sender,
        )  # fmt: skip
        self._odometry: Message | None = None
        self._T_map_odom: FloatArray | None = None
        self.tell_strangers(outbox.strangers, "sent")
        self.tell_strangers(self.store.strangers, "sent")
        if waiting := outbox.waiting:
            node.get_logger().info(f"{len(waiting)} submaps of before wait for the post")
        node.listen_together(SUBMAP_TOPICS, self.on_submap, latched=True, required=False, stamps=StampPolicy.ANY)
        node.listen("odom", "Odometry", self.on_odometry, required=False, stamps=StampPolicy.ANY)
        if config.correction_topic:
            node.advertise(config.correction_topic, "TransformStamped", latched=True, depth=1, alone=True)
        self.hear(f"slam/{self.name}/ack", self.on_acknowledgement)
        self.hear(f"slam/{self.name}/want", self.on_want)
        self.hear(f"slam/{self.name}/correction", self.on_correction)

    def on_submap(self, *messages: Message) -> None:
        """Pack a finished submap and keep it until the post has it."""
        submap = submap_from_messages(SubmapMessages(*messages))
        key = submap.session, submap.index
        if self.uplink.outbox.knows(key):
            self.node.health.count("submaps sent again")
            return
        submap = replace(submap, agent=self.name)
        message = pack(submap, self.node.config.light)
        self.keep_details(self.store, key, submap, message)
        try:
            self.uplink.add_submap(key, message, time.monotonic())
        except OSError as error:
            raise ValueError(f"submap {submap.index} cannot be kept for the post: {error}") from error
        self.node.health.count("submaps packed")
        self.views.on_submap(submap)

    def on_odometry(self, message: Message) -> None:
        """Keep the newest pose; publish where the post's map has it."""
        self._odometry = message
        self.views.on_pose(pose_from_message(message.pose.pose))
        topic = self.node.config.correction_topic
        if self._T_map_odom is not None and topic:
            config = self.node.config
            frames = config.map_frame, message.header.frame_id or config.odom_frame
            correction = transform_message(self.node.types, stamp_ns(message), *frames, self._T_map_odom)
            self.node.publish(topic, correction)
            if config.broadcast_tf:
                self.node.broadcast(correction)

    def on_acknowledgement(self, _: str, data: bytes) -> None:
        """The post is there and has some submaps."""
        self.uplink.on_acknowledgement(unpack_acknowledgement(data), time.monotonic())

    def on_want(self, _: str, data: bytes) -> None:
        """The post lacks the details of some submaps."""
        self.details.want(unpack_want(data))
        self.uplink.on_heard(time.monotonic())

    def on_correction(self, _: str, data: bytes) -> None:
        """Publish where this agent's odometry is in the post's map."""
        self._T_map_odom = unpack_correction(data)[1]
        self.uplink.on_heard(time.monotonic())
        self.node.health.count("corrections")
        if self._odometry is not None:
            self.on_odometry(self._odometry)

    def pump(self, now_s: float) -> None:
        """Send what is due."""
        if self._odometry is not None and self.uplink.pose_is_due(now_s):
            self.uplink.set_pose(pack_pose(estimate_from_message(self._odometry)))
            self._odometry = None
        for message in self.uplink.due(now_s):
            self.send(f"slam/{self.name}/{message.path}", message.data, urgent=message.key is None)

    def state(self, now_s: float) -> LinkState:
        """Health of the link."""
        counts = {
            "submaps waiting": len(self.uplink.outbox.waiting), "resent": self.uplink.resent,
            "details sent": self.details.sent, "details that cannot be told": self.store.damaged,
        }  # fmt: skip
        self.node.health.take(counts)
        self.views.show()
        return self.uplink.state(now_s)

    def close(self) -> None:
        """Keep what waits for the next start."""
        self.uplink.outbox.close()
        self.store.close()
        self.views.close()


class PostEnd(End):
    """Submaps and poses in, acknowledgements and corrections out."""

    def __init__(self, node: LinkNode) -> None:
        super().__init__(node)
        config = node.config
        inboxes = [Inbox(agent, node.state_folder / "inbox" / agent) for agent in config.agents]
        self.views = PostViews(self, config.agents)
        self.downlink = Downlink(inboxes, config.bytes_per_second, config.silent_after_s, self.views.inboxes)
        self.publisher = SubmapPublisher(node, config.agents, self.views.on_submap)
        for inbox in inboxes:
            self.tell_strangers(inbox.strangers, "passed on")
        for agent in config.agents:
            correction = partial(self.on_map_to_odom, agent)
            node.listen(
                f"{agent}/map_to_odom", "TransformStamped", correction,
                latched=True, required=False, stamps=StampPolicy.ANY,
            )  # fmt: skip
        DetailRequests(node, inboxes)
        for agent in config.agents:
            self.hear(f"slam/{agent}/pose", partial(self.on_pose, agent))
            self.hear(f"slam/{agent}/submap/*/*", partial(self.on_submap, agent))
            self.hear(f"slam/{agent}/details/*/*", partial(self.on_details, agent))
            self.hear(f"slam/{agent}/none", partial(self.on_none, agent))
            self.hear(f"slam/{agent}/piece", partial(self.on_piece, agent))
            self.hear(f"slam/{agent}/backlog", partial(self.on_backlog, agent))

    def on_pose(self, agent: str, _: str, data: bytes) -> None:
        """Publish an agent's odometry."""
        self.publisher.pass_on_pose(agent, self.downlink.on_pose(agent, data, time.monotonic()))

    def on_submap(self, agent: str, name: str, data: bytes) -> None:
        """Keep a submap and publish what is in order."""
        self.publisher.pass_on(agent, self.downlink.on_submap(agent, submap_key(name), data, time.monotonic()))

    def on_details(self, agent: str, name: str, data: bytes) -> None:
        """Keep details and publish their submap once more, with them."""
        submaps = self.downlink.on_details(agent, submap_key(name), data, time.monotonic())
        self.publisher.pass_on(agent, submaps)
        self.node.health.count("details received")

    def on_none(self, agent: str, _: str, data: bytes) -> None:
        """An agent cannot tell some details: they are not asked for again, but with all others."""
        if count := self.downlink.on_none(agent, data, time.monotonic()):
            self.node.health.count("details that agents cannot tell", count)

    def on_piece(self, agent: str, _: str, data: bytes) -> None:
        """Keep a piece of a view, and publish the view if that is whole."""
        self.views.on_piece(agent, self.downlink.on_piece(agent, data, time.monotonic()))

    def on_backlog(self, agent: str, _: str, data: bytes) -> None:
        """Keep what waits at an agent."""
        self.downlink.on_backlog(agent, data, time.monotonic())

    def on_map_to_odom(self, agent: str, message: Message) -> None:
        """Keep the newest correction of an agent."""
        self.downlink.set_correction(agent, stamp_ns(message), transform_from_message(message)[2])

    def pump(self, now_s: float) -> None:
        """Send what is due."""
        self.publisher.pass_on_again(self.downlink.inboxes)
        for agent, kind, data in self.downlink.due(now_s):
            self.send(f"slam/{agent}/{kind}", data, urgent=True)

    def state(self, now_s: float) -> LinkState:
        """Health of the link."""
        self.publisher.show(self.downlink, now_s)
        self.node.health.take({"details wanted": sum(len(inbox.wanted) for inbox in self.downlink.inboxes)})
        self.views.show()
        return self.downlink.state(now_s)

    def reset(self) -> None:
        """Forget what has come; it is not sent again."""
        for inbox in self.downlink.inboxes:
            inbox.forget()
        self.views.reset()

    def close(self) -> None:
        """Keep what has come for the next start."""
        for inbox in self.downlink.inboxes:
            inbox.close()
        self.views.close()


class DetailRequests:
    """Requests for details of submaps that have come: of those that the map is undecided about, or of all."""

    def __init__(self, node: LinkNode, inboxes: Iterable[Inbox]) -> None:
        self._inboxes = tuple(inboxes)
        node.listen("map/undecided", "DiagnosticArray", self.on_undecided, latched=True, required=False,
                    stamps=StampPolicy.ANY)  # fmt: skip
        node.serve("~/request_details", self.request_all)

    def on_undecided(self, message: Message) -> None:
        """The map cannot tell if some submaps are of one place: ask for all that their agents know of them."""
        keys = submap_keys_from_message(message)
        for inbox in self._inboxes:
            inbox.ask((session, index) for agent, session, index in keys if agent == inbox.agent)

    def request_all(self) -> str:
        """Ask for the details of all submaps that have come."""
        return f"details of {sum(inbox.ask() for inbox in self._inboxes)} submaps asked for"


class SubmapPublisher:
    """Submaps and poses of agents as ``sjsam`` reads them, below their names."""

    def __init__(
        self, node: LinkNode, agents: Iterable[str], notice: Callable[[str, Submap], None] | None = None
    ) -> None:
        self.node, self._notice = node, notice
        self._begun = False
        for agent in agents:
            for topic, kind in SUBMAP_TOPICS.items():
                node.advertise(f"{agent}/{topic}", kind, latched=True)
            node.advertise(f"{agent}/odom", "Odometry")

    def pass_on(self, agent: str, submaps: Iterable[Submap]) -> None:
        """Publish submaps of an agent."""
        for submap in submaps:
            for topic, message in zip(SUBMAP_TOPICS, submap_messages(self.node.types, submap), strict=True):
                self.node.publish(f"{agent}/{topic}", message)
            self.node.health.count("submaps passed on")
            if self._notice is not None:
                self._notice(agent, submap)

    def pass_on_pose(self, agent: str, pose: PoseEstimate) -> None:
        """Publish a pose of an agent as its odometry."""
        config = self.node.config
        frames = f"{agent}/{config.odom_frame}", f"{agent}/{config.base_frame}"
        self.node.publish(f"{agent}/odom", odometry_message(self.node.types, *frames, pose))
        self.node.health.count("poses passed on")

    def pass_on_again(self, inboxes: Iterable[Inbox]) -> None:
        """Publish, at the first call, what had come before this start: all nodes of this process listen by then."""
        if self._begun:
            return
        self._begun = True
        for inbox in inboxes:
            if submaps := inbox.release():
                self.node.get_logger().info(
                    f"{len(submaps)} submaps of {inbox.agent} from before are passed on again (~/reset forgets them)"
                )
            self.pass_on(inbox.agent, submaps)

    def show(self, downlink: Downlink, now_s: float) -> None:
        """Counts of what has come, and the link to each agent, in the diagnostics."""
        inboxes, health = downlink.inboxes, self.node.health
        health.take(
            {"submaps repeated": sum(i.repeated for i in inboxes), "submaps held": sum(i.held for i in inboxes)}
        )
        for agent, report in downlink.reports(now_s).items():
            for name, value in report.values(agent).items():
                health.show(name, value)


def submap_key(name: str) -> Key:
    """Session and index of ``slam/<agent>/submap/<session>/<index>``."""
    session, index = name.split("/")[-2:]
    if not (session.isdecimal() and index.isdecimal()):
        raise ValueError(f"the key of a submap ends with session and index, got {name}")
    return int(session), int(index)
