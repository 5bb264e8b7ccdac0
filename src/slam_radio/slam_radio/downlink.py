# SPDX-License-Identifier: Apache-2.0
"""The command post's side of the link: what agents have sent, what they are told, and which of them are silent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from slam_core.geometry import FloatArray, boxminus
from slam_core.health import State
from slam_core.types import PoseEstimate, Submap
from slam_radio.link_state import Hearing, LinkState
from slam_radio.queues.byte_budget import OVERHEAD, ByteBudget
from slam_radio.queues.inbox import Inbox
from slam_radio.views.view_format import PlacedImage
from slam_radio.views.view_inbox import ViewInbox
from slam_radio.wire.index_ranges import Key, Range
from slam_radio.wire.link_report import Backlog, LinkReport, unpack_backlog
from slam_radio.wire.radio_messages import (
    MOST_RANGES,
    pack_acknowledgement,
    pack_correction,
    pack_want,
    unpack_none,
    unpack_pose,
)
from slam_radio.wire.view_messages import Lack, pack_look

_BEACON_PERIOD_S = 3.0
"""An acknowledgement goes out so often even if there is no news: agents learn from it that the post is there."""
_LEAST_PERIOD_S = 0.25
_LOOK_PERIOD_S = 1.0
"""News of pieces that have come go out so often at most: four seconds of the link are under way."""
_CORRECTION_PERIOD_S = 1.0
_REMINDER_PERIOD_S = 10.0
_LEAST_CHANGE = np.repeat([1e-3, 2e-4], 3)
"""A correction that has changed by less, m and rad, is sent as a reminder only."""


class Message(NamedTuple):
    """A message for an agent, ``kind`` being ``ack``, ``want``, ``look`` or ``correction``."""

    agent: str
    kind: str
    data: bytes


class _Agent:
    """The post's record of one agent."""

    def __init__(self, inbox: Inbox, silent_after_s: float, views: ViewInbox | None) -> None:
        self.inbox, self.views = inbox, views
        self.hearing = Hearing(silent_after_s)
        self.backlog: Backlog | None = None
        self.has_news = False
        self.told_at_s = float("-inf")
        self.wants: list[Range] | None = []
        self.wanted_at_s = float("-inf")
        self.first_want = 0
        self.looks: list[Lack] | None = []
        self.looked_at_s = float("-inf")
        self.correction: tuple[int, FloatArray] | None = None
        self.corrected_by: FloatArray | None = None
        self.corrected_at_s = float("-inf")

    def want_is_due(self, lacking: list[Range], now_s: float) -> bool:
        """True if the agent does not know what is wanted, or may have to be told again."""
        pause_s = now_s - self.wanted_at_s
        return pause_s >= _LEAST_PERIOD_S if self.wants != lacking else bool(lacking) and pause_s >= _BEACON_PERIOD_S

    def look_is_due(self, lacks: list[Lack], now_s: float) -> bool:
        """True if the agent does not know which pieces of views are lacking, or may have to be told again."""
        pause_s = now_s - self.looked_at_s
        return pause_s >= _LOOK_PERIOD_S if self.looks != lacks else bool(lacks) and pause_s >= _BEACON_PERIOD_S

    def correction_is_due(self, now_s: float) -> bool:
        """True if there is a correction that the agent does not have, or has not had for long."""
        if self.correction is None:
            return False
        gone_s = now_s - self.corrected_at_s
        if self.corrected_by is None or (np.abs(boxminus(self.correction[1], self.corrected_by)) > _LEAST_CHANGE).any():
            return gone_s >= _CORRECTION_PERIOD_S
        return gone_s >= _REMINDER_PERIOD_S


class Downlink:
    """Takes messages of agents, and decides what they are told. Times are those of any steady clock, s.

    ``budget``: bytes a second on the wire, or one that several share. ``views``: those of each agent, where some may be
    asked for.
    """

    def __init__(
        self, inboxes: Iterable[Inbox], budget: float | ByteBudget, silent_after_s: float = 10.0,
        views: Mapping[str, ViewInbox] | None = None,
    ) -> None:  # fmt: skip
        found = views or {}
        self._agents = {i.agent: _Agent(i, silent_after_s, found.get(i.agent)) for i in inboxes}
        self._budget = budget if isinstance(budget, ByteBudget) else ByteBudget(budget)

    @property
    def inboxes(self) -> list[Inbox]:
        """Submaps that each agent has sent."""
        return [agent.inbox for agent in self._agents.values()]

    def on_submap(self, name: str, key: Key, data: bytes, now_s: float) -> list[Submap]:
        """Take a submap; returns what may be passed on. Raises as :meth:`Inbox.take`."""
        agent = self._agents[name]
        agent.hearing.heard(now_s)
        submaps = agent.inbox.take(key, data)
        agent.has_news = True
        return submaps

    def on_details(self, name: str, key: Key, data: bytes, now_s: float) -> list[Submap]:
        """Take details of a submap; returns what may be passed on. Raises as :meth:`Inbox.take_details`."""
        agent = self._agents[name]
        agent.hearing.heard(now_s)
        submaps = agent.inbox.take_details(key, data)
        agent.wants = None  # the agent is to know that they have come
        return submaps

    def on_none(self, name: str, data: bytes, now_s: float) -> int:
        """An agent cannot tell details that were wanted; returns of how many submaps. ValueError if it is damaged."""
        agent = self._agents[name]
        ranges = unpack_none(data)
        agent.hearing.heard(now_s)
        return agent.inbox.give_up(ranges)

    def on_piece(self, name: str, data: bytes, now_s: float) -> PlacedImage | None:
        """Take a piece of a view; returns the view if it is whole. Raises as :meth:`ViewInbox.take`."""
        agent = self._agents[name]
        assert agent.views is not None
        agent.hearing.heard(now_s)
        agent.looks = None  # the agent is to know that it has come
        return agent.views.take(data)

    def on_pose(self, name: str, data: bytes, now_s: float) -> PoseEstimate:
        """Take a pose; ValueError if it is damaged."""
        agent = self._agents[name]
        pose = unpack_pose(data)
        agent.has_news |= not agent.hearing.is_up(now_s)
        agent.hearing.heard(now_s)
        return pose

    def on_backlog(self, name: str, data: bytes, now_s: float) -> None:
        """Take what waits at an agent; ValueError if it is damaged."""
        agent = self._agents[name]
        agent.backlog = unpack_backlog(data)
        agent.hearing.heard(now_s)

    def set_correction(self, name: str, stamp_ns: int, T_map_odom: FloatArray) -> None:
        """The map knows where an agent's odometry is."""
        self._agents[name].correction = stamp_ns, T_map_odom

    def due(self, now_s: float) -> list[Message]:
        """Messages to send now."""
        out = []
        for name, agent in self._agents.items():
            pause_s = now_s - agent.told_at_s
            if pause_s >= (_LEAST_PERIOD_S if agent.has_news else _BEACON_PERIOD_S):
                data = pack_acknowledgement(agent.inbox.acknowledgement())
                if self._take_budget(data, now_s):
                    agent.told_at_s, agent.has_news = now_s, False
                    out.append(Message(name, "ack", data))
            lacking = agent.inbox.lacking()
            if agent.want_is_due(lacking, now_s) and agent.hearing.is_up(now_s):
                first = agent.first_want % len(lacking) if len(lacking) > MOST_RANGES else 0
                data = pack_want(lacking[first:] + lacking[:first])  # of many, others each time
                if self._take_budget(data, now_s):
                    agent.wanted_at_s, agent.wants, agent.first_want = now_s, lacking, first + MOST_RANGES
                    out.append(Message(name, "want", data))
            lacks = [] if agent.views is None else agent.views.lacks()
            if agent.look_is_due(lacks, now_s) and agent.hearing.is_up(now_s):
                data = pack_look(lacks)
                if self._take_budget(data, now_s):
                    agent.looked_at_s, agent.looks = now_s, lacks
                    if lacks and agent.views is not None:
                        agent.views.count_look()
                    out.append(Message(name, "look", data))
            if agent.correction_is_due(now_s) and agent.hearing.is_up(now_s):
                data = pack_correction(*agent.correction)  # type: ignore[misc]
                if self._take_budget(data, now_s):
                    agent.corrected_at_s, agent.corrected_by = now_s, agent.correction[1]  # type: ignore[index]
                    out.append(Message(name, "correction", data))
        return out

    def reports(self, now_s: float) -> dict[str, LinkReport]:
        """State of the link to each agent."""
        return {
            name: LinkReport(agent.hearing.is_up(now_s), agent.hearing.heard_s_ago(now_s), agent.backlog)
            for name, agent in self._agents.items()
        }

    def state(self, now_s: float) -> LinkState:
        """All agents up, or which are silent or have more than their link carries; and what waits at all of them."""
        silent = [text for name, a in self._agents.items() if (text := a.hearing.text(name, now_s))]
        known = {name: agent.backlog for name, agent in self._agents.items() if agent.backlog is not None}
        crowded = [
            f"more comes in at {name} ({b.came:.0f} bytes/s) than its link carries ({b.carried:.0f})"
            for name, b in known.items()
            if b.is_too_much and self._agents[name].hearing.is_up(now_s)  # what a silent one said is old
        ]
        size = sum(b.size for b in known.values())
        seconds = max((b.seconds for b in known.values()), default=0.0)
        faults = "; ".join(silent + crowded)
        return LinkState(State.DEGRADED if faults else State.OK, faults or "all agents heard", size, seconds)

    def _take_budget(self, data: bytes, now_s: float) -> bool:
        size = len(data) + OVERHEAD
        if not self._budget.allows(size, now_s):
            return False
        self._budget.spend(size)
        return True
