# SPDX-License-Identifier: Apache-2.0
"""Pacing of a player by those who process: who is there, the stamps on their way to each node, a replay's clock."""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping


def header_stamp_ns(data: bytes) -> int:
    """Header stamp of a message that starts with a header, from its CDR bytes (encapsulation, then sec and nanosec)."""
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


class FlowControl:
    """Lets at most ``window`` messages of a topic be on their way to the node that has to have processed them.

    Thread-safe: one thread sends, another one reports progress.

    Parameters
    ----------
    pairs
        "node=topic" texts: full node name, full topic name.
    window
        Messages of a topic that may be unprocessed.
    patience_s
        How long to wait for a node that reports nothing before going on without it.
    """

    def __init__(self, pairs: Iterable[str], window: int, patience_s: float) -> None:
        split = [pair.partition("=") for pair in pairs]
        if bad := [pair for pair in split if not pair[0] or not pair[2]]:
            raise ValueError(f"pace must be '<node>=<topic>', got {''.join(bad[0])!r}")
        self._on_the_way: dict[tuple[str, str], deque[int]] = {(node, topic): deque() for node, _, topic in split}
        self._window = window
        self._patience_s = patience_s
        self._changed = threading.Condition()
        self.gave_up = 0
        """Times that patience ran out."""

    @property
    def topics(self) -> set[str]:
        """Topics that are paced."""
        return {topic for _, topic in self._on_the_way}

    def progress(self, node: str, stamp_ns: int) -> None:
        """``node`` has processed everything up to ``stamp_ns``."""
        with self._changed:
            for (name, _), stamps in self._on_the_way.items():
                if name == node:
                    _forget_up_to(stamps, stamp_ns)
            self._changed.notify_all()

    def sent(self, topic: str, stamp_ns: int) -> None:
        """A message of ``topic`` has been published."""
        with self._changed:
            for (_, paced), stamps in self._on_the_way.items():
                if paced == topic:
                    stamps.append(stamp_ns)

    def wait(self, topic: str) -> bool:
        """Block until ``topic`` may send again; False if patience ran out: what was on its way is then forgotten."""
        return self._wait_until(lambda: self._most_on_the_way(topic) < self._window)

    def drain(self) -> bool:
        """Block until everything sent has been processed; False if patience ran out."""
        return self._wait_until(lambda: not any(self._on_the_way.values()))

    def clear(self) -> None:
        """Forget what is on its way, for instance when a bag starts again."""
        with self._changed:
            for stamps in self._on_the_way.values():
                stamps.clear()

    def _most_on_the_way(self, topic: str) -> int:
        return max((len(s) for (_, paced), s in self._on_the_way.items() if paced == topic), default=0)

    def _wait_until(self, condition: Callable[[], bool]) -> bool:
        with self._changed:
            left = self._total()
            while not condition():
                if not self._changed.wait(self._patience_s) and self._total() == left:
                    self.gave_up += 1
                    for stamps in self._on_the_way.values():
                        stamps.clear()
                    return False
                left = self._total()
        return True

    def _total(self) -> int:
        return sum(len(s) for s in self._on_the_way.values())


def _forget_up_to(stamps: deque[int], stamp_ns: int) -> None:
    """Drop what was sent up to the last stamp that is not newer; an odd stamp before it is never reported itself."""
    done = max((i for i, stamp in enumerate(stamps) if stamp <= stamp_ns), default=-1)
    for _ in range(done + 1):
        stamps.popleft()


class RequiredSubscribers:
    """Numbers of subscribers that each topic must have before its first message is sent.

    Parameters
    ----------
    pairs
        "topic=number" texts; ValueError for another form.
    """

    def __init__(self, pairs: Iterable[str]) -> None:
        split = [pair.rpartition("=") for pair in pairs]
        if bad := ["".join(parts) for parts in split if not parts[0] or not parts[2].isdecimal()]:
            raise ValueError(f"subscribers must be '<topic>=<number>', got {bad[0]!r}")
        self._expected = {topic: int(number) for topic, _, number in split}

    def forget_all_but(self, topics: Iterable[str]) -> None:
        """Expect nobody on topics that are not played."""
        played = set(topics)
        self._expected = {topic: number for topic, number in self._expected.items() if topic in played}

    def missing(self, matched: Callable[[str], int]) -> list[str]:
        """Topics that fewer subscribers are matched with than expected, sorted."""
        return sorted(topic for topic, number in self._expected.items() if matched(topic) < number)


class Connections:
    """Last diagnostics of the nodes, as far as they tell whether these are there and connected to each other."""

    def __init__(self) -> None:
        self._unconnected: dict[str, set[str]] = {}

    def report(self, name: str, values: Mapping[str, str]) -> None:
        """Diagnostic values of the node of this full name."""
        self._unconnected[name] = set(values.get("unconnected", "").split())

    def obstacles(self, names: Iterable[str], from_outside: Iterable[str] = ()) -> list[str]:
        """Nodes that have not reported themselves, or lack a publisher of an input that is not ``from_outside``."""
        found, outside = [], set(from_outside)
        for name in names:
            if name not in self._unconnected:
                found.append(f"{name} has not reported itself")
            elif lacking := self._unconnected[name] - outside:
                found.append(f"{name} has no publisher of {', '.join(sorted(lacking))}")
        return found


class ReplayClock:
    """Due times of a bag's messages: ``rate`` times as fast as it was recorded; rate 0 is as fast as possible."""

    def __init__(self, rate: float) -> None:
        if rate < 0.0:
            raise ValueError(f"rate must not be negative, got {rate}")
        self._rate = rate
        self._origin: tuple[float, int] | None = None

    def delay_s(self, stamp_ns: int) -> float:
        """Seconds until the message of ``stamp_ns`` is due, 0 if it is late; the first one starts the clock."""
        if self._rate == 0.0:
            return 0.0
        now = time.monotonic()
        if self._origin is None:
            self._origin = (now, stamp_ns)
        started, first_ns = self._origin
        return max(started + (stamp_ns - first_ns) / 1e9 / self._rate - now, 0.0)
