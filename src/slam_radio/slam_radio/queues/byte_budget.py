# SPDX-License-Identifier: Apache-2.0
"""Token bucket: the bytes that a sender may put on a shared channel."""

from __future__ import annotations

OVERHEAD = 150
"""Bytes on the wire beside a message's own: key, headers of Zenoh, TCP and IP, and the other side's TCP answer."""
_SAVED_S = 2.0
"""Unused budget is kept for so long."""


class ByteBudget:
    """Allows ``bytes_per_second``; in T seconds no more than T + 2 s of it and one message go out.

    Times are those of any steady clock, s.
    """

    def __init__(self, bytes_per_second: float) -> None:
        self.bytes_per_second = bytes_per_second
        self._capacity = _SAVED_S * bytes_per_second
        self._level, self._at_s = self._capacity, float("-inf")

    def allows(self, size: int, now_s: float) -> bool:
        """True if a message of ``size`` bytes may go out now: one that is larger than all savings waits for all."""
        self._level = min(self._capacity, self._level + self.bytes_per_second * max(0.0, now_s - self._at_s))
        self._at_s = max(self._at_s, now_s)
        return self._level >= min(size, self._capacity)

    def spend(self, size: int) -> None:
        """A message of ``size`` bytes goes out; the budget may run into debt, which later messages wait for."""
        self._level -= size
