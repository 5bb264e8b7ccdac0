# SPDX-License-Identifier: Apache-2.0
"""Messages that are not acknowledged yet: how many bytes may be under way, and when one goes out again."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

_WINDOW_S = 4.0
"""So many seconds of the budget, or one message, may be under way."""
_LONGEST_WAIT_S = 60.0


@dataclass
class _Sent:
    tries: int
    due_s: float
    size: int
    is_repeated: bool


class InFlight:
    """Messages under way on a link. Times are those of any steady clock, s.

    One that is not acknowledged goes out again after a time that doubles from try to try, up to a minute, and is longer
    by what the link needs for all that is under way.
    """

    def __init__(self, bytes_per_second: float, resend_after_s: float) -> None:
        self.bytes_per_second, self.resent = bytes_per_second, 0
        self._resend_after_s = resend_after_s
        self._sent: dict[Hashable, _Sent] = {}

    def is_due(self, key: Hashable, now_s: float) -> bool:
        """True if a message was not sent yet, or has to go out again."""
        return key not in self._sent or self._sent[key].due_s <= now_s

    def fits(self, size: int, now_s: float) -> bool:
        """True if a message of so many bytes may be under way too."""
        under_way = self._under_way(now_s)
        return not under_way or under_way + size <= _WINDOW_S * self.bytes_per_second

    def sent(self, key: Hashable, size: int, now_s: float) -> None:
        """A message goes out."""
        tries = self._sent[key].tries + 1 if key in self._sent else 1
        is_repeated = self._sent.pop(key, None) is not None
        self.resent += is_repeated
        wait = min(self._resend_after_s * 2.0 ** (tries - 1), _LONGEST_WAIT_S)
        arrives_s = (self._under_way(now_s) + size) / self.bytes_per_second
        self._sent[key] = _Sent(tries, now_s + wait + arrives_s, size, is_repeated)

    def landed(self, key: Hashable) -> None:
        """The other side has a message, or does not want it any more."""
        self._sent.pop(key, None)

    def overtaken(self, by: Iterable[Hashable], now_s: float) -> None:
        """Send again what went out before one of these, which have landed: it is lost.

        Messages arrive in the order in which they went out. One that went out several times says nothing: its first
        copy may be the one that has landed.
        """
        order = list(self._sent)
        last = max((order.index(key) for key in by if key in self._sent and not self._sent[key].is_repeated), default=0)
        for key in order[:last]:
            self._sent[key].due_s, self._sent[key].tries = now_s, 0

    def hurry(self, now_s: float) -> None:
        """The other side is back: what was under way may have been lost, and need not wait for long any more."""
        for sent in self._sent.values():
            sent.due_s, sent.tries = min(sent.due_s, now_s + self._resend_after_s), 1

    def _under_way(self, now_s: float) -> int:
        """Bytes of messages whose acknowledgement may still come."""
        return sum(sent.size for sent in self._sent.values() if sent.due_s > now_s)
