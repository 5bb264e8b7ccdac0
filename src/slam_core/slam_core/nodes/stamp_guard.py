# SPDX-License-Identifier: Apache-2.0
"""Tells a message with an odd stamp from a clock that has jumped, without any clock but the stamps themselves.

Each stream (topic) of an agent's sensors runs forward in small steps. A stamp that does not go on from the one before
is *held* together with its message until others have shown what it is:

- the stream goes on as before: what was held is an outlier, rejected;
- three stamps in a row agree with each other and lie ahead: a gap in the data; all are released, nothing is lost;
- three in a row agree and lie behind: the clock has jumped back for good, a new *session* begins with them.

Only frames begin sessions; what accompanies them (IMU, motions) follows. The other streams join a session when their
stamps are near its own; stragglers of the session before are rejected, and so is a stamp that comes twice in a row.

The nodes judge what they receive by it, ``slam run`` what it reads from a bag, and ``slam doctor`` a recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")

CONFIRMATIONS = 3
"""Stamps in a row that must agree before a jump is believed."""

LONGEST_STEP_NS = 1_000_000_000
"""A step forward that needs no confirmation; slow streams may also go three times their last step."""

LATE_NS = 250_000_000
"""A stamp behind by less is a message out of order."""

NEAR_NS = 10_000_000_000
"""Streams of one session differ by less."""

_UNKNOWN_STEP_NS = 60_000_000_000
"""Longest step between the first two stamps of what may be a slow stream."""


class StampPolicy(Enum):
    """Meaning of a topic's stamps. FRAMES run in order and begin sessions, FOLLOWS run in order, ANY are not judged."""

    FRAMES = "frames"
    FOLLOWS = "follows"
    ANY = "any"


class StampFault(Enum):
    """Kind of a rejected stamp; the values are what it is called where it is counted."""

    DUPLICATE = "duplicate stamps"
    LATE = "stamps out of order"
    ODD = "stamps off their stream"


@dataclass(frozen=True)
class StampDecision(Generic[T]):
    """Decision about messages: those ``released`` as (stamp_ns, item) in order, stamps ``rejected`` and why.

    new_session: what was released is the first of a new session. fault: kind of those rejected, None if none are.
    """

    released: tuple[tuple[int, T], ...] = ()
    rejected: tuple[int, ...] = ()
    reason: str = ""
    new_session: bool = False
    fault: StampFault | None = None


@dataclass
class _Stream(Generic[T]):
    """One topic: newest stamp accepted in this session, the stamp before it, and what is held.

    contradicted: another stream went on in the session while this one's messages were held.
    """

    last_ns: int | None = None
    floor_ns: int | None = None
    held: list[tuple[int, T]] = field(default_factory=list)
    contradicted: bool = False

    @property
    def longest_step_ns(self) -> int:
        """Step forward that needs no confirmation."""
        if self.last_ns is None or self.floor_ns is None:
            return LONGEST_STEP_NS
        return max(LONGEST_STEP_NS, 3 * (self.last_ns - self.floor_ns))

    def repeats(self, stamp_ns: int) -> bool:
        """True if a stamp is the newest accepted, or the newest held, once more."""
        return stamp_ns == self.last_ns or (bool(self.held) and stamp_ns == self.held[-1][0])

    def goes_on(self, stamp_ns: int) -> bool:
        """True if a stamp is the stream's next."""
        return self.last_ns is not None and 0 <= stamp_ns - self.last_ns <= self.longest_step_ns

    def is_late(self, stamp_ns: int) -> bool:
        """True if a stamp is a little out of order, or behind nothing but the stream's last step."""
        if self.last_ns is None or stamp_ns >= self.last_ns:
            return False
        return self.last_ns - stamp_ns < LATE_NS or (self.floor_ns is not None and stamp_ns > self.floor_ns)

    def agrees_with_held(self, stamp_ns: int) -> bool:
        """True if a stamp is the next of those held."""
        if not self.held:
            return False
        step = stamp_ns - self.held[-1][0]
        if len(self.held) == 1:
            return 0 <= step <= _UNKNOWN_STEP_NS
        return 0 <= step <= max(LONGEST_STEP_NS, 3 * (self.held[-1][0] - self.held[-2][0]))

    def accept(self, items: list[tuple[int, T]]) -> None:
        """Take stamps as the stream's newest; nothing is held any more."""
        for stamp_ns, _ in items:
            self.floor_ns, self.last_ns = self.last_ns, stamp_ns
        self.held, self.contradicted = [], False


class StampGuard(Generic[T]):
    """Judges the stamps of all streams of one agent, message by message; ``session`` counts the jumps."""

    def __init__(self) -> None:
        self.session = 0
        self._streams: dict[str, _Stream[T]] = {}

    def add(self, name: str, stamp_ns: int, item: T, *, starts_sessions: bool = True) -> StampDecision[T]:
        """Judge one message of stream ``name``."""
        stream = self._streams.setdefault(name, _Stream())
        if stream.repeats(stamp_ns):
            return StampDecision(rejected=(stamp_ns,), reason="its stamp has come before", fault=StampFault.DUPLICATE)
        if stream.last_ns is None and self._is_near(stamp_ns):
            return self._join(stream, stamp_ns, item)
        if stream.goes_on(stamp_ns):
            return self._release(stream, [(stamp_ns, item)], outliers=stream.held)
        if stream.is_late(stamp_ns):
            return StampDecision(
                rejected=(stamp_ns,),
                reason=f"{_seconds(stream.last_ns, stamp_ns)} older than the one before",
                fault=StampFault.LATE,
            )
        return self._hold(stream, stamp_ns, item, starts_sessions)

    def finish(self) -> list[tuple[str, StampDecision[T]]]:
        """Decide on what is held when the input has ended, by stream.

        What lies ahead by no more than streams of one session differ is released as what follows a gap.
        """
        return [(name, self._decide(stream)) for name, stream in self._streams.items() if stream.held]

    def _decide(self, stream: _Stream[T]) -> StampDecision[T]:
        last, held = self._reference(stream), stream.held
        if last is not None and 0 < held[0][0] - last <= NEAR_NS:
            return self._release(stream, held, outliers=[])
        stream.held = []
        return _rejection(last, held)

    def restart(self) -> None:
        """Forget all streams: whatever comes next is the first."""
        self.session += 1
        self._streams.clear()

    def _is_near(self, stamp_ns: int) -> bool:
        """True if a stamp belongs to the session's time; ahead of it may be a straggler of the session before."""
        known = [s.last_ns for s in self._streams.values() if s.last_ns is not None]
        ahead = NEAR_NS if self.session == 0 else LATE_NS
        return not known or any(-NEAR_NS <= stamp_ns - last <= ahead for last in known)

    def _join(self, stream: _Stream[T], stamp_ns: int, item: T) -> StampDecision[T]:
        """A stream's first message in a session, with those of it that were held as a jump."""
        first = 0
        for i, (held_ns, _) in enumerate(stream.held):
            if not (self._is_near(held_ns) and held_ns <= stamp_ns):
                first = i + 1
        return self._release(stream, [*stream.held[first:], (stamp_ns, item)], outliers=stream.held[:first])

    def _release(
        self, stream: _Stream[T], items: list[tuple[int, T]], outliers: list[tuple[int, T]]
    ) -> StampDecision[T]:
        decision = _rejection(stream.last_ns, outliers, items)
        stream.accept(items)
        for other in self._streams.values():
            other.contradicted |= other is not stream and bool(other.held)
        return decision

    def _hold(self, stream: _Stream[T], stamp_ns: int, item: T, starts_sessions: bool) -> StampDecision[T]:
        refuted: list[tuple[int, T]] = []
        if not stream.agrees_with_held(stamp_ns):
            refuted, stream.held, stream.contradicted = stream.held, [], False
        stream.held.append((stamp_ns, item))
        if len(stream.held) >= CONFIRMATIONS:
            if self._is_gap(stream):
                return self._release(stream, stream.held, refuted)
            if starts_sessions and (stream.last_ns is not None or not stream.contradicted):
                return self._begin_session(stream)
            refuted.append(stream.held.pop(0))
        return _rejection(self._reference(stream), refuted)

    def _is_gap(self, stream: _Stream[T]) -> bool:
        """True if what is held lies ahead in the stream's own time, or in that of the session where it has none."""
        if stream.last_ns is not None:
            return stream.held[0][0] > stream.last_ns
        return any(
            0 <= stream.held[0][0] - s.last_ns <= NEAR_NS for s in self._streams.values() if s.last_ns is not None
        )

    def _begin_session(self, stream: _Stream[T]) -> StampDecision[T]:
        items, before = stream.held, self._reference(stream)
        self.session += 1
        for other in self._streams.values():
            other.last_ns = other.floor_ns = None
        stream.accept(items)
        return StampDecision(
            tuple(items), reason=f"time jumped back by {_seconds(before, items[0][0])}", new_session=True
        )

    def _reference(self, stream: _Stream[T]) -> int | None:
        """The stamp that a stream's next one is compared with."""
        known = [s.last_ns for s in self._streams.values() if s.last_ns is not None]
        return stream.last_ns if stream.last_ns is not None else max(known, default=None)


def _rejection(
    reference_ns: int | None, outliers: list[tuple[int, T]], released: Sequence[tuple[int, T]] = ()
) -> StampDecision[T]:
    """Decision that rejects outliers, if there are any, beside what is released."""
    rejected = tuple(stamp for stamp, _ in outliers)
    if not rejected:
        return StampDecision(tuple(released))
    return StampDecision(tuple(released), rejected, _off(reference_ns, rejected[0]), fault=StampFault.ODD)


def _seconds(later_ns: int | None, earlier_ns: int) -> str:
    return f"{((later_ns or 0) - earlier_ns) / 1e9:.3f} s"


def _off(reference_ns: int | None, stamp_ns: int) -> str:
    """In words: how far a stamp is from where it should be."""
    if reference_ns is None:
        return "its stamp does not go on from the one before"
    off_s = (stamp_ns - reference_ns) / 1e9
    return f"its stamp is {abs(off_s):.3f} s {'ahead of' if off_s > 0 else 'behind'} the stream"
