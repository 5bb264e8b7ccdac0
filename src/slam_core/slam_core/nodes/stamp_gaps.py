# SPDX-License-Identifier: Apache-2.0
"""Counts the frames missing in a stream by its stamps alone, whoever lost them: camera, driver or transport."""

from __future__ import annotations

from collections import deque
from statistics import median

_STEPS = 9
"""Steps whose median is the stream's period: one gap, or a few, do not change it."""
_FEWEST = 3


class StampGaps:
    """``missing``: frames that did not come between those that came."""

    def __init__(self) -> None:
        self.missing = 0
        self._steps: deque[int] = deque(maxlen=_STEPS)
        self._last_ns: int | None = None

    def add(self, stamp_ns: int) -> int:
        """Take a stamp; returns how many frames are missing before it. One that is not newer is left out."""
        step = 0 if self._last_ns is None else stamp_ns - self._last_ns
        if self._last_ns is not None and step <= 0:
            return 0
        self._last_ns = stamp_ns
        missing = 0
        if len(self._steps) >= _FEWEST:
            missing = max(round(step / median(self._steps)) - 1, 0)
        if step:
            self._steps.append(step // (missing + 1))
        self.missing += missing
        return missing

    def restart(self) -> None:
        """A new session begins: the next stamp has nothing before it."""
        self._last_ns = None
        self._steps.clear()
