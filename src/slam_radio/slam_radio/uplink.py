# SPDX-License-Identifier: Apache-2.0
"""An agent's side of the link: what goes out next, within the budget, and what has to go out again.

The newest pose goes first and always, once a second. Submaps follow oldest first, as far as the budget allows and while
the post is heard; few are under way at a time, so that a slow link does not fill with what poses would wait behind. One
that is not acknowledged goes out again as soon as one that went out later is, else after a time that doubles from try
to try. How much waits is told while it waits, and when nothing does any more. Details that the post wants come when no
submap waits, and pictures and dense key frames when no details go out either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from slam_core.health import State
from slam_radio.link_state import Carriage, Hearing, LinkState
from slam_radio.queues.byte_budget import OVERHEAD, ByteBudget
from slam_radio.queues.detail_sender import DetailSender
from slam_radio.queues.in_flight import InFlight
from slam_radio.queues.outbox import Outbox
from slam_radio.views.view_sender import ViewSender
from slam_radio.wire.index_ranges import Key, Range
from slam_radio.wire.link_report import Backlog, pack_backlog
from slam_radio.wire.radio_messages import pack_submap

_POSE_PERIOD_S = 1.0
_BACKLOG_PERIOD_S = 5.0
_BACKLOG_REMINDER_S = 30.0
_LEAST_WAIT_S = 2.0
"""A shorter wait is not told: nearly every submap has one."""


@dataclass(frozen=True)
class Outgoing:
    """A message to send, ``key`` of a submap; ``kind``: pose, submap, details, none, backlog, piece or unseen."""

    kind: str
    data: bytes
    key: Key | None = None

    @property
    def path(self) -> str:
        """The end of its key expression."""
        return self.kind if self.key is None else f"{self.kind}/{self.key[0]}/{self.key[1]}"


class Uplink:
    """Decides what goes out. Times are those of any steady clock, s.

    Parameters
    ----------
    outbox
        Submaps that wait.
    budget
        Budget on the wire, bytes a second; or one that several share.
    resend_after_s
        A submap that is not acknowledged goes out again after so long, then after twice that, up to a minute.
    silent_after_s
        The post counts as silent when nothing came from it for so long.
    details, views
        What the post may ask for.
    """

    def __init__(
        self, outbox: Outbox, budget: float | ByteBudget, resend_after_s: float = 5.0, silent_after_s: float = 10.0,
        details: DetailSender | None = None, views: ViewSender | None = None,
    ) -> None:  # fmt: skip
        self.outbox, self.details, self.views = outbox, details, views
        self._budget = budget if isinstance(budget, ByteBudget) else ByteBudget(budget)
        self._flight = InFlight(self._budget.bytes_per_second, resend_after_s)
        self._hearing = Hearing(silent_after_s)
        self._carriage = Carriage()
        self._pose: bytes | None = None
        self._pose_due_s = float("-inf")
        self._since_s: dict[Key, float] = {}
        self._told: Backlog | None = None
        self._told_at_s = float("-inf")

    @property
    def resent(self) -> int:
        """Submaps that went out again."""
        return self._flight.resent

    def set_pose(self, data: bytes) -> None:
        """Replace the pose that goes out next."""
        self._pose = data

    def pose_is_due(self, now_s: float) -> bool:
        """True if a pose would go out now."""
        return now_s >= self._pose_due_s

    def add_submap(self, key: Key, light: bytes, now_s: float) -> None:
        """Keep a submap until the post has it."""
        self.outbox.add(key, light)
        self._since_s[key] = now_s
        self._carriage.came(len(light) + OVERHEAD, now_s)

    def on_acknowledgement(self, ranges: Iterable[Range], now_s: float) -> None:
        """The post is there, and has these submaps."""
        self.on_heard(now_s)
        sizes = {key: self.outbox.size(key) for key in self.outbox.waiting}
        landed = self.outbox.acknowledge(ranges)
        self._flight.overtaken(landed, now_s)
        for key in landed:
            self._flight.landed(key)
            self._since_s.pop(key, None)
            self._carriage.carried(sizes[key] + OVERHEAD, now_s)

    def on_heard(self, now_s: float) -> None:
        """The post is there; after a silence what was under way goes out again soon."""
        if not self._hearing.is_up(now_s):
            self._flight.hurry(now_s)
            for asked in (self.details, self.views):
                if asked is not None:
                    asked.hurry(now_s)
        self._hearing.heard(now_s)

    def due(self, now_s: float) -> list[Outgoing]:
        """Messages to send now, in this order."""
        out = self.due_pose(now_s)
        while (key := self.ready(now_s)) is not None and self.affords(key, now_s):
            out.append(self.take(key, now_s))
        out += self.due_backlog(now_s) + self.due_details(now_s)
        return out + self.due_views(now_s)

    def due_details(self, now_s: float) -> list[Outgoing]:
        """Details that the post wants, and which there are not, while no submap waits."""
        out = self.due_none(now_s)
        while (key := self.ready_details(now_s)) is not None and self.affords_details(key, now_s):
            out += self.take_details(key, now_s)
        return out

    def due_none(self, now_s: float) -> list[Outgoing]:
        """The details that the post wants and there are not, while no submap waits."""
        if self.details is None or self.outbox.waiting or not self._hearing.is_up(now_s):
            return []
        none = self.details.none()
        if none is None or not self._budget.allows(len(none) + OVERHEAD, now_s):
            return []
        self._budget.spend(len(none) + OVERHEAD)
        self.details.none_is_sent()
        return [Outgoing("none", none)]

    def ready_details(self, now_s: float) -> Key | None:
        """Key of the details that go out next, as soon as the budget allows; None while a submap waits."""
        if self.details is None or self.outbox.waiting or not self._hearing.is_up(now_s):
            return None
        return self.details.ready(now_s)

    def affords_details(self, key: Key, now_s: float) -> bool:
        """True if the budget allows details that are ready."""
        return self.details is not None and self._budget.allows(self.details.size(key), now_s)

    def take_details(self, key: Key, now_s: float) -> list[Outgoing]:
        """The message of details, which goes out now; none if their file is gone."""
        assert self.details is not None
        size = self.details.size(key)
        if (data := self.details.take(key, now_s)) is None:
            return []
        self._budget.spend(size)
        return [Outgoing("details", data, key)]

    def due_views(self, now_s: float) -> list[Outgoing]:
        """Pieces of views that the post lacks, and names of those which there are not, while nothing else waits."""
        out: list[Outgoing] = []
        if self.views is None or self.outbox.waiting or not self._hearing.is_up(now_s):
            return out
        if self.details is not None and self.details.ready(now_s) is not None:
            return out
        if (unseen := self.views.unseen()) is not None and self._budget.allows(len(unseen) + OVERHEAD, now_s):
            self._budget.spend(len(unseen) + OVERHEAD)
            self.views.unseen_is_sent()
            out.append(Outgoing("unseen", unseen))
        while (piece := self.views.ready(now_s)) is not None:
            size = self.views.size(piece)
            if not self._budget.allows(size, now_s):
                break
            self._budget.spend(size)
            out.append(Outgoing("piece", self.views.take(piece, now_s)))
        return out

    def due_pose(self, now_s: float) -> list[Outgoing]:
        """The newest pose, where it is to go out now."""
        if self._pose is None or not self.pose_is_due(now_s):
            return []
        out = [Outgoing("pose", self._pose)]
        self._budget.spend(len(self._pose) + OVERHEAD)
        self._pose, self._pose_due_s = None, now_s + _POSE_PERIOD_S
        return out

    def ready(self, now_s: float) -> Key | None:
        """The submap that goes out next, as soon as the budget allows; None while there is none or the post is away."""
        if not self._hearing.is_up(now_s):
            return None
        key = next((key for key in self.outbox.waiting if self._flight.is_due(key, now_s)), None)
        return key if key is not None and self._flight.fits(self._wire_size(key), now_s) else None

    def affords(self, key: Key, now_s: float) -> bool:
        """True if the budget allows a submap."""
        return self._budget.allows(self._wire_size(key), now_s)

    def take(self, key: Key, now_s: float) -> Outgoing:
        """The message of a submap, which goes out now."""
        message = Outgoing("submap", pack_submap(*self.outbox.read(key)), key)
        self._budget.spend(self._wire_size(key))
        self._flight.sent(key, self._wire_size(key), now_s)
        return message

    def due_backlog(self, now_s: float) -> list[Outgoing]:
        """The backlog, every few seconds while there is one, once when it is gone, and as a reminder."""
        if not self._hearing.is_up(now_s):
            return []
        waits, told_s = self._oldest_s(now_s) > _LEAST_WAIT_S, now_s - self._told_at_s
        ended = not self.outbox.waiting and self._told is not None and self._told.submaps > 0
        if not (ended or told_s >= (_BACKLOG_PERIOD_S if waits else _BACKLOG_REMINDER_S)):
            return []
        backlog = self.backlog(now_s)
        data = pack_backlog(backlog)
        if not self._budget.allows(len(data) + OVERHEAD, now_s):
            return []
        self._budget.spend(len(data) + OVERHEAD)
        self._told, self._told_at_s = backlog, now_s
        return [Outgoing("backlog", data)]

    def backlog(self, now_s: float) -> Backlog:
        """Submaps that wait, and the rates of the last minute."""
        waiting, size = self.outbox.waiting, self.outbox.bytes_waiting
        seconds = (size + OVERHEAD * len(waiting)) / self._budget.bytes_per_second
        too_much = self._carriage.is_too_much(self._oldest_s(now_s), self._hearing.up_for_s(now_s), now_s)
        return Backlog(len(waiting), size, seconds, *self._carriage.rates(now_s), too_much)

    def state(self, now_s: float) -> LinkState:
        """Link up or silent, and what waits."""
        b = self.backlog(now_s)
        waits = f"{b.submaps} submaps ({b.size / 1e3:.1f} kB, {b.seconds:.0f} s) wait"
        silence = self._hearing.text("the post", now_s)
        if silence:
            return LinkState(State.DEGRADED, f"{silence}, {waits}", b.size, b.seconds)
        if b.is_too_much:
            why = f"more comes in ({b.came:.0f} bytes/s) than the link carries ({b.carried:.0f}): {waits}"
            return LinkState(State.DEGRADED, why, b.size, b.seconds)
        return LinkState(State.OK, "link up", b.size, b.seconds)

    def _oldest_s(self, now_s: float) -> float:
        """Time that the oldest submap has waited."""
        return max((now_s - self._since_s.setdefault(key, now_s) for key in self.outbox.waiting), default=0.0)

    def _wire_size(self, key: Key) -> int:
        return self.outbox.size(key) + OVERHEAD


class UplinkTurns:
    """Uplinks that share a budget: a submap of one, then it is the others' turn; details so when no submap is due."""

    def __init__(self, uplinks: dict[str, Uplink]) -> None:
        self._uplinks = uplinks
        self._order = list(uplinks)

    def due(self, now_s: float) -> list[tuple[str, Outgoing]]:
        """Messages to send now, each with the name of its link."""
        out = [(name, pose) for name in self._order for pose in self._uplinks[name].due_pose(now_s)]
        while (turn := self._first(Uplink.ready, now_s)) is not None:
            name, key = turn
            if not self._uplinks[name].affords(key, now_s):
                break  # nor may another one: a link of smaller submaps would always be sooner
            out.append((name, self._uplinks[name].take(key, now_s)))
            self._is_served(name)
        out += [(name, told) for name in self._order for told in self._uplinks[name].due_backlog(now_s)]
        return out if turn is not None else out + self._due_details(now_s)

    def _due_details(self, now_s: float) -> list[tuple[str, Outgoing]]:
        out = [(name, none) for name in self._order for none in self._uplinks[name].due_none(now_s)]
        while (turn := self._first(Uplink.ready_details, now_s)) is not None:
            name, key = turn
            if not self._uplinks[name].affords_details(key, now_s):
                break
            out += [(name, details) for details in self._uplinks[name].take_details(key, now_s)]
            self._is_served(name)
        return out

    def _first(self, ready: Callable[[Uplink, float], Key | None], now_s: float) -> tuple[str, Key] | None:
        """The first link in turn that has something ready, and the key of that."""
        found = ((name, ready(self._uplinks[name], now_s)) for name in self._order)
        return next(((name, key) for name, key in found if key is not None), None)

    def _is_served(self, name: str) -> None:
        self._order.remove(name)
        self._order.append(name)
