# SPDX-License-Identifier: Apache-2.0
"""Checks that stamps go forward at an even rate, on one clock, and together where images belong together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from slam_bags.reading.agent_stream import FOLLOWING
from slam_bringup.doctor.evidence import Evidence, Stamps, Stream
from slam_bringup.doctor.finding import Finding
from slam_core.geometry import FloatArray
from slam_core.nodes.stamp_guard import StampDecision, StampFault, StampGuard
from slam_core.nodes.synchronizer import PAIRING_TOLERANCE_S
from stereo_frontend.depth.depth_fusion import FusionConfig

_LOST_SHARE = 0.03
_KEY_FRAMES_SHARE = 0.6
"""Above this share of frames left out a set was thinned on purpose."""
_ON_GRID, _GRID_TOLERANCE = 0.8, 0.15
_RATE_SPREAD = 1.5
_CLOCKS_APART_S = 0.5
_FEWEST = 8
_CHECK = {
    StampFault.DUPLICATE: "same stamp twice",
    StampFault.LATE: "time goes back",
    StampFault.ODD: "odd stamps",
}
_ADVICE = {
    StampFault.DUPLICATE: "does the driver publish twice?",
    StampFault.LATE: "does the driver publish from several threads?",
    StampFault.ODD: "was the clock set while recording (NTP, a restarted camera)?",
}


def check_stamps(evidence: Evidence) -> Iterator[Finding]:
    """Order, rate, losses and clocks of each stream, then the time between streams."""
    yield from _order(evidence)
    for role, stream in evidence.streams.items():
        if role in ("left", "right", "depth", "range") and len(stream.stamps) >= _FEWEST:
            yield from _rate(stream)
    yield from _clocks(evidence)
    yield from _pairing(evidence)


def _order(evidence: Evidence) -> Iterator[Finding]:
    """Stamps that ``slam run`` and the nodes leave out, by the same guard, in the order of the recording."""
    guard, judged = StampGuard[None](), {role: _Judged() for role in evidence.streams}
    for role, stamp in _as_recorded(evidence.streams):
        judged[role].take(guard.add(role, stamp, None, starts_sessions=role not in FOLLOWING))
    for role, decision in guard.finish():
        judged[role].take(decision)
    for role, stream in evidence.streams.items():
        zeros = int((stream.stamps == 0).sum())
        if zeros:
            yield Finding(
                "no stamp",
                f"{zeros} of {len(stream.stamps)} messages on {stream.topic} have the stamp 0",
                "make the driver fill header.stamp",
                zeros == len(stream.stamps),
            )
        else:
            yield from judged[role].findings(stream.topic)


@dataclass
class _Judged:
    """Faults of a stream's stamps: how many of each kind, and the first one in words."""

    number: Counter[StampFault] = field(default_factory=Counter)
    reason: dict[StampFault, str] = field(default_factory=dict)
    jumps: list[str] = field(default_factory=list)

    def take(self, decision: StampDecision[None]) -> None:
        if decision.fault is not None:
            self.number[decision.fault] += len(decision.rejected)
            self.reason.setdefault(decision.fault, decision.reason)
        self.jumps += [decision.reason] * decision.new_session

    def findings(self, topic: str) -> Iterator[Finding]:
        for jump in self.jumps[:1]:
            yield Finding(
                "time goes back",
                f"{jump} on {topic}, {len(self.jumps)} times in all",
                "were two recordings joined, or the clock set while recording?",
            )
        for fault, number in self.number.items():
            yield Finding(
                _CHECK[fault], f"{number} messages on {topic} are left out: {self.reason[fault]}", _ADVICE[fault]
            )


def _as_recorded(streams: Mapping[str, Stream]) -> list[tuple[str, int]]:
    """Role and stamp of every message, in the order of the recording."""
    rows = [
        (time, role, stamp)
        for role, stream in streams.items()
        for time, stamp in zip(stream.times.tolist(), stream.stamps.tolist(), strict=True)
    ]
    return [(role, stamp) for _, role, stamp in sorted(rows, key=lambda row: row[0])]


def _rate(stream: Stream) -> Iterator[Finding]:
    steps = np.diff(np.unique(stream.stamps)) / 1e9
    if len(steps) < _FEWEST:
        return
    base = float(np.percentile(steps, 10))
    multiples = np.maximum(np.rint(steps / base), 1.0)
    if np.mean(np.abs(steps / base - multiples) < _GRID_TOLERANCE) < _ON_GRID:
        low, high = np.percentile(steps, [10, 90])
        if high > _RATE_SPREAD * low:
            yield Finding(
                "uneven rate",
                f"{stream.topic} comes between {1 / high:.1f} and {1 / low:.1f} times a second",
                "fix the frame rate (automatic exposure may lower it)",
            )
        return
    lost = float((multiples - 1.0).sum() / multiples.sum())
    if _LOST_SHARE < lost < _KEY_FRAMES_SHARE:
        yield Finding(
            "lost frames",
            f"{stream.topic} lacks {lost:.0%} of its frames at {1 / base:.1f} Hz",
            "record to a faster disk, compress, or lower the rate",
        )


def _clocks(evidence: Evidence) -> Iterator[Finding]:
    """Time of recording against stamps: the same for all sensors, whatever it is."""
    delays = {s.topic: float(np.median(s.times - s.stamps)) / 1e9 for s in evidence.streams.values() if len(s.stamps)}
    if not delays or max(delays.values()) - min(delays.values()) < _CLOCKS_APART_S:
        return
    middle = float(np.median(list(delays.values())))
    odd = max(delays, key=lambda topic: abs(delays[topic] - middle))
    yield Finding(
        "two clocks",
        f"the stamps of {odd} are {middle - delays[odd]:+.1f} s off those of the other sensors",
        "let all drivers take the host's clock, or synchronise (PTP, chrony)",
    )


def _pairing(evidence: Evidence) -> Iterator[Finding]:
    streams = evidence.streams
    if {"left", "right"} <= streams.keys():
        yield from _stereo_pairs(streams["left"], streams["right"])
    depth = evidence.depth_role
    if "left" in streams and depth:
        apart = _apart_s(streams["left"].stamps, streams[depth].stamps)
        if len(apart) and FusionConfig().max_age < np.median(apart) < _CLOCKS_APART_S:
            yield Finding(
                "depth stamps apart",
                f"depth images are {np.median(apart) * 1000:.0f} ms from their pairs",
                "trigger both cameras together, or correct the driver's delay",
            )


def _stereo_pairs(left: Stream, right: Stream) -> Iterator[Finding]:
    apart = _apart_s(left.stamps, right.stamps)
    if not len(apart):
        return
    alone = float(np.mean(apart > PAIRING_TOLERANCE_S))
    middle = float(np.median(apart))
    if middle > PAIRING_TOLERANCE_S:
        yield Finding(
            "stereo stamps apart",
            f"left and right are {middle * 1000:.1f} ms apart, no pair can be made",
            "trigger both cameras together (input.pairing_tolerance_s makes pairs that are not)",
            True,
        )
    elif alone > _LOST_SHARE:
        yield Finding(
            "unpaired images",
            f"{alone:.0%} of the left images have no right partner",
            "was one camera dropped while recording?",
        )


def _apart_s(first: Stamps, second: Stamps) -> FloatArray:
    """Seconds from each of ``first`` to the nearest of ``second``, empty if either is."""
    if not len(first) or not len(second):
        return np.empty(0)
    ordered = np.sort(second)
    after = np.searchsorted(ordered, first).clip(1, max(len(ordered) - 1, 1))
    neighbours = np.stack([ordered[after - 1], ordered[np.minimum(after, len(ordered) - 1)]])
    return np.asarray(np.abs(neighbours - first).min(axis=0) / 1e9)
