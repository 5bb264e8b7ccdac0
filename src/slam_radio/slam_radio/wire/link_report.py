# SPDX-License-Identifier: Apache-2.0
"""State of the link to one agent as the post knows it, and its form as values of ``/diagnostics``."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_BACKLOG = struct.Struct("<HIfffB")
_MOST_WAITING = 0xFFFF
_LARGEST = 1e9
_NAMES = ("heard_s_ago", "submaps_waiting", "backlog_bytes", "backlog_s", "in_bytes_per_second",
          "carried_bytes_per_second", "too_much")  # fmt: skip


@dataclass(frozen=True)
class Backlog:
    """Submaps that wait at an agent.

    submaps, size: number and bytes. seconds: time that the budget needs for them. came, carried: bytes a second that
    came in and that the post acknowledged in the last minute. is_too_much: more comes in than the link carries, and it
    waits.
    """

    submaps: int
    size: int
    seconds: float
    came: float
    carried: float
    is_too_much: bool


@dataclass(frozen=True)
class LinkReport:
    """State of the link to one agent; ``backlog`` is what it said last, ``heard_s_ago`` None: it was never heard."""

    is_up: bool
    heard_s_ago: float | None = None
    backlog: Backlog | None = None

    def values(self, agent: str) -> dict[str, str]:
        """Names and texts for ``/diagnostics``."""
        parts = {"link": "up" if self.is_up else "silent"}
        known: tuple[object, ...] = () if self.heard_s_ago is None else (f"{self.heard_s_ago:.1f}",)
        if known and (b := self.backlog) is not None:
            known += (b.submaps, b.size, f"{b.seconds:.1f}", f"{b.came:.0f}", f"{b.carried:.0f}", int(b.is_too_much))
        # what is not known any more is told as such: values of a node stay until they are replaced
        told = [*map(str, known), *[""] * (len(_NAMES) - len(known))]
        return {f"{agent}/{name}": text for name, text in (parts | dict(zip(_NAMES, told, strict=True))).items()}

    @classmethod
    def of(cls, agent: str, values: Mapping[str, str]) -> LinkReport | None:
        """Inverse of :meth:`values`; None where they say nothing of this agent.

        Raises
        ------
        ValueError
            If a value is no number where there must be one.
        """
        if f"{agent}/link" not in values:
            return None
        heard, *rest = [_number(values.get(f"{agent}/{name}", "")) for name in _NAMES]
        backlog = None
        if None not in rest:
            submaps, size, seconds, came, carried, too_much = (float(n) for n in rest if n is not None)
            backlog = Backlog(int(submaps), int(size), seconds, came, carried, bool(too_much))
        return cls(values[f"{agent}/link"] == "up", heard, backlog)


def pack_backlog(backlog: Backlog) -> bytes:
    """The 19 bytes of a backlog: u16 submaps, u32 bytes, f32 s, 2 x f32 bytes a second (in, carried), u8 too much."""
    rates = (min(backlog.came, _LARGEST), min(backlog.carried, _LARGEST))
    counts = min(backlog.submaps, _MOST_WAITING), min(backlog.size, 2**32 - 1)
    return _BACKLOG.pack(*counts, min(backlog.seconds, _LARGEST), *rates, backlog.is_too_much)


def unpack_backlog(data: bytes) -> Backlog:
    """Inverse of :func:`pack_backlog`; ValueError for bytes that are none."""
    if len(data) != _BACKLOG.size:
        raise ValueError(f"a backlog has {_BACKLOG.size} bytes, got {len(data)}")
    submaps, size, seconds, came, carried, too_much = _BACKLOG.unpack(data)
    if not all(0.0 <= n <= 2.0 * _LARGEST for n in (seconds, came, carried)) or too_much > 1:
        raise ValueError(f"a backlog holds numbers that cannot be: {seconds}, {came}, {carried}, {too_much}")
    return Backlog(submaps, size, seconds, came, carried, bool(too_much))


def _number(text: str) -> float | None:
    if not text:
        return None
    value = float(text)
    if not np.isfinite(value) or value < 0.0:
        raise ValueError(f"a link cannot have {text}")
    return value
