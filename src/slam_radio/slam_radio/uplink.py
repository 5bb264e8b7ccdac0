# SPDX-License-Identifier: Apache-2.0
"""An agent's side of the link: what goes out next, within the budget, and what has to go out again.

The newest pose goes first and always, once a second. Submaps follow oldest first, as far as the budget allows and while
the post is heard; few are under way at a time, so that a slow link does not fill with what poses would wait behind. One
that is not acknowledged goes out again after a time that doubles from try to try.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from slam_core.health import State
from slam_radio.byte_budget import ByteBudget
from slam_radio.index_ranges import Key, Range
from slam_radio.link_state import Carriage, Hearing, LinkState
from slam_radio.outbox import Outbox
from slam_radio.radio_messages import pack_submap

OVERHEAD = 150
"""Bytes on the wire beside a message's own: key, headers of Zenoh, TCP and IP, and the other side's TCP answer."""
_POSE_PERIOD_S = 1.0
_WINDOW_S = 4.0
"""So many seconds of the budget, or one submap, may be under way."""
_LONGEST_WAIT_S = 60.0


@dataclass(frozen=True)
class Outgoing:
    """A message to send: ``key`` of a submap, None for the pose."""

    key: Key | None
    data: bytes


@dataclass
class _Sent:
    tries: int
    due_s: float


class Uplink:
    """Decides what goes out. Times are those of any steady clock, s.

    Parameters
    ----------
    outbox
        Submaps that wait.
    bytes_per_second
        Budget on the wire.
    resend_after_s
        A submap that is not acknowledged goes out again after so long, then after twice that, up to a minute.
    silent_after_s
        The post counts as silent when nothing came from it for so long.
    """

    def __init__(
        self, outbox: Outbox, bytes_per_second: float, resend_after_s: float = 5.0, silent_after_s: float = 10.0
    ) -> None:
        self.outbox = outbox
        self.resent = 0
        self._budget = ByteBudget(bytes_per_second)
        self._resend_after_s = resend_after_s
        self._hearing = Hearing(silent_after_s)
        self._carriage = Carriage()
        self._pose: bytes | None = None
        self._pose_due_s = float("-inf")
        self._sent: dict[Key, _Sent] = {}
        self._since_s: dict[Key, float] = {}

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
        if not self._hearing.is_up(now_s):  # what is under way may have been lost: it need not wait for long any more
            for sent in self._sent.values():
                sent.due_s, sent.tries = min(sent.due_s, now_s + self._resend_after_s), 1
        self.on_heard(now_s)
        sizes = {key: self.outbox.size(key) for key in self.outbox.waiting}
        for key in self.outbox.acknowledge(ranges):
            self._sent.pop(key, None)
            self._since_s.pop(key, None)
            self._carriage.carried(sizes[key] + OVERHEAD, now_s)

    def on_heard(self, now_s: float) -> None:
        """The post is there."""
        self._hearing.heard(now_s)

    def due(self, now_s: float) -> list[Outgoing]:
        """Messages to send now, in this order."""
        out = []
        if self._pose is not None and self.pose_is_due(now_s):
            out.append(Outgoing(None, self._pose))
            self._budget.spend(len(self._pose) + OVERHEAD)
            self._pose, self._pose_due_s = None, now_s + _POSE_PERIOD_S
        if self._hearing.is_up(now_s):
            out += self._due_submaps(now_s)
        return out

    def state(self, now_s: float) -> LinkState:
        """Link up or silent, and what waits."""
        waiting, backlog = self.outbox.waiting, self.outbox.bytes_waiting
        backlog_s = (backlog + OVERHEAD * len(waiting)) / self._budget.bytes_per_second
        waits = f"{len(waiting)} submaps ({backlog / 1e3:.1f} kB, {backlog_s:.0f} s) wait"
        silence = self._hearing.text("the post", now_s)
        if silence:
            return LinkState(State.DEGRADED, f"{silence}, {waits}", backlog, backlog_s)
        oldest_s = max((now_s - self._since_s.setdefault(key, now_s) for key in waiting), default=0.0)
        if self._carriage.is_too_much(oldest_s, self._hearing.up_for_s(now_s), now_s):
            came, carried = self._carriage.rates(now_s)
            why = f"more comes in ({came:.0f} bytes/s) than the link carries ({carried:.0f}): {waits}"
            return LinkState(State.DEGRADED, why, backlog, backlog_s)
        return LinkState(State.OK, "link up", backlog, backlog_s)

    def _due_submaps(self, now_s: float) -> list[Outgoing]:
        out: list[Outgoing] = []
        window = _WINDOW_S * self._budget.bytes_per_second
        under_way = sum(self.outbox.size(k) for k, sent in self._sent.items() if sent.due_s > now_s)
        for key in self.outbox.waiting:
            sent = self._sent.get(key)
            if sent is not None and sent.due_s > now_s:
                continue
            size = self.outbox.size(key) + OVERHEAD
            if (under_way and under_way + size > window) or not self._budget.allows(size, now_s):
                break
            out.append(Outgoing(key, pack_submap(*self.outbox.read(key))))
            self._budget.spend(size)
            under_way += size
            tries = sent.tries + 1 if sent is not None else 1
            self.resent += tries > 1
            wait = min(self._resend_after_s * 2.0 ** (tries - 1), _LONGEST_WAIT_S)
            self._sent[key] = _Sent(tries, now_s + wait + under_way / self._budget.bytes_per_second)
        return out
