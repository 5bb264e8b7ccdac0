# SPDX-License-Identifier: Apache-2.0
"""A node's own condition: state, counters, rate and time per message; the content of ``/diagnostics``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from enum import IntEnum


class State(IntEnum):
    """Condition of an estimator, as in its diagnostics; the values are DiagnosticStatus levels."""

    OK = 0
    DEGRADED = 1
    LOST = 2


class Health:
    """State of a node with its reason, and what it has counted and measured.

    Counters since the start, values of the newest input, rate and duration since the last report.
    """

    def __init__(self) -> None:
        self.state = State.OK
        self.reason = "waiting for input"
        self.counters: Counter[str] = Counter()
        self.values: dict[str, str] = {}
        self._durations: list[float] = []
        self._frames = 0
        self._reported_at: float | None = None

    def set(self, state: State, reason: str = "") -> None:
        """Set the state; ``reason`` says why it is not OK."""
        self.state, self.reason = state, reason

    def count(self, what: str, number: int = 1) -> None:
        """Add to a counter, for instance "rejected"."""
        self.counters[what] += number

    def take(self, counts: Mapping[str, int]) -> None:
        """Set counters that an algorithm keeps itself."""
        for what, number in counts.items():
            self.counters[what] = number

    def show(self, what: str, value: object) -> None:
        """Set a value of the newest input, for instance "score"."""
        self.values[what] = str(value)

    def processed(self, duration_s: float, *, is_frame: bool = True) -> None:
        """One input was processed in ``duration_s``.

        A frame, or what accompanies frames (an IMU's reading, a motion that a frame has waited for). The rate is that
        of frames; the mean latency is all the work there was per frame.
        """
        self.count("processed")
        self._durations.append(duration_s)
        self._frames += is_frame

    def report(self, now_s: float, diagnostic: str = "") -> dict[str, str]:
        """Key and text of every value; starts a new period for rate and durations. ``now_s`` is any steady clock.

        ``diagnostic``: fault beside the estimator's own, with which no state is OK.
        """
        period = now_s - self._reported_at if self._reported_at is not None else 0.0
        durations, self._durations, self._reported_at = self._durations, [], now_s
        state = max(self.state, State.DEGRADED) if diagnostic else self.state
        values = {"state": state.name, "reason": "; ".join(filter(None, (diagnostic, self.reason)))}
        frames, self._frames = self._frames, 0
        values["rate_hz"] = f"{frames / period:.2f}" if period > 0.0 else "0.00"
        if frames:
            values["latency_mean_ms"] = f"{1e3 * sum(durations) / frames:.2f}"
            values["latency_max_ms"] = f"{1e3 * max(durations):.2f}"
        return values | self.values | {name: str(number) for name, number in sorted(self.counters.items())}
