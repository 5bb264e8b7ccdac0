# SPDX-License-Identifier: Apache-2.0
"""An agent and a post on a made-up channel, in made-up time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam_core.types import PoseEstimate, Submap
from slam_radio.downlink import Downlink
from slam_radio.packing.light_submap import LightConfig, pack
from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.queues.detail_sender import DetailSender
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.inbox import Inbox
from slam_radio.queues.outbox import Outbox
from slam_radio.uplink import Uplink
from slam_radio.views.view_files import ViewFiles
from slam_radio.views.view_inbox import ViewInbox
from slam_radio.views.view_sender import ViewSender
from slam_radio.wire.radio_messages import pack_pose, unpack_acknowledgement, unpack_want
from slam_radio.wire.view_messages import unpack_look, unpack_piece, unpack_unseen

SIZE = LightConfig(landmarks=5, rank=1)
STEP_S = 0.1


@dataclass
class World:
    """One agent, ``one``, and the post; ``arrives(to_post, now_s)`` says what the channel lets through."""

    folder: Path
    make: Callable[..., Submap]
    arrives: Callable[[bool, float], bool] = lambda to_post, now_s: True
    bytes_per_second: float = 2000.0
    now_s: float = 0.0
    landmarks: int = 5
    detailed: list[Submap] = field(default_factory=list)
    detail_keys: list[int] = field(default_factory=list)
    wants: int = 0
    looks: int = 0
    pieces: list[tuple[int, int]] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    told_none: list[int] = field(default_factory=list)
    passed_on: list[int] = field(default_factory=list)
    sent: list[tuple[float, int]] = field(default_factory=list)
    keys: list[int] = field(default_factory=list)
    poses: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.start_agent()
        self.start_post()

    def start_agent(self) -> None:
        if hasattr(self, "uplink"):
            self.uplink.outbox.close()
            self.uplink.details.store.close()
            self.uplink.views.files.close()
        details = DetailSender(DetailStore(self.folder / "details"), self.bytes_per_second)
        views = ViewSender(ViewFiles(self.folder / "shots", 1e6), self.bytes_per_second)
        self.uplink = Uplink(Outbox(self.folder / "out"), self.bytes_per_second, details=details, views=views)

    def start_post(self) -> list[int]:
        """Start the post anew; the indices that it passes on again."""
        if hasattr(self, "downlink"):
            self.inbox.close()
            self.views.close()
        self.inbox = Inbox("one", self.folder / "in")
        self.views = ViewInbox("one", self.folder / "views", 1e6)
        self.downlink = Downlink([self.inbox], 2000.0, views={"one": self.views})
        return [s.index for s in self.inbox.release()]

    def submap(self, index: int) -> None:
        submap = self.whole(index)
        message = pack(submap, SIZE)
        if self.uplink.details is not None:
            self.uplink.details.store.keep((2, index), submap, message)
        self.uplink.add_submap((2, index), message, self.now_s)

    def whole(self, index: int) -> Submap:
        """A submap as its agent has it."""
        return self.make(self.landmarks, seed=index, index=index)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            self._step()

    def _step(self) -> None:
        now = self.now_s
        if self.uplink.pose_is_due(now):
            self.uplink.set_pose(pack_pose(PoseEstimate(round(now * 1e9), np.eye(4), 1e-4 * np.eye(6))))
        for message in self.uplink.due(now):
            self.sent.append((now, len(message.data) + OVERHEAD))
            self.kinds.append(message.kind)
            if message.kind == "piece":
                piece = unpack_piece(message.data)
                self.pieces.append((piece.key.stamp_ns, piece.number))
            elif message.kind == "details":
                self.detail_keys.append(message.key[1])
            elif message.key is not None:
                self.keys.append(message.key[1])
            if not self.arrives(True, now):
                continue
            if message.kind == "backlog":
                self.downlink.on_backlog("one", message.data, now)
            elif message.kind == "piece":
                view = self.downlink.on_piece("one", message.data, now)
                self.seen += [] if view is None else [view.stamp_ns]
            elif message.kind == "unseen":
                self.views.give_up(unpack_unseen(message.data))
            elif message.kind == "none":
                self.told_none.append(self.downlink.on_none("one", message.data, now))
            elif message.key is None:
                self.poses.append((now, self.downlink.on_pose("one", message.data, now).stamp_ns))
            elif message.kind == "details":
                self.detailed += self.downlink.on_details("one", message.key, message.data, now)
            else:
                self.passed_on += [s.index for s in self.downlink.on_submap("one", message.key, message.data, now)]
        for told in self.downlink.due(now):
            if not self.arrives(False, now):
                continue
            if told.kind == "ack":
                self.uplink.on_acknowledgement(unpack_acknowledgement(told.data), now)
            elif told.kind == "want":
                self.wants += 1
                self.uplink.details.want(unpack_want(told.data))
            elif told.kind == "look":
                self.looks += 1
                self.uplink.views.lack(unpack_look(told.data), now)
