# SPDX-License-Identifier: Apache-2.0
"""Decides which streams a frame still has to wait for, by stamps alone, so that a stream that dies stops nothing.

A frame waits until every stream has reached its stamp: results then do not depend on the order in which messages happen
to arrive. A stream that is more than ``patience`` frames behind the newest frame is *silent*: nobody waits for it until
it has caught up. No clock is involved, so a replay gives the same result at any speed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Protocol

PATIENCE = 10
"""Frames that may wait for a stream: more than a player lets be on their way at once, so that a slow start of a replay
is not taken for silence; a third of a second at 30 Hz.
"""


class Stamped(Protocol):
    """Anything with a header stamp."""

    @property
    def stamp_ns(self) -> int:
        """The stamp, ns."""
        ...


class AwaitedStreams:
    """Newest stamp of every stream that frames wait for.

    Parameters
    ----------
    expected
        Streams waited for from the first frame on; others once they were heard.
    patience
        Frames that may wait for a stream before it counts as silent.
    """

    def __init__(self, expected: Iterable[str] = (), patience: int = PATIENCE) -> None:
        self._expected = tuple(expected)
        self._patience = patience
        self.clear()

    def clear(self) -> None:
        """Forget every stamp: the streams that are expected are waited for anew."""
        self._newest: dict[str, int | None] = dict.fromkeys(self._expected)
        self._frames: deque[int] = deque(maxlen=self._patience + 1)
        self._given_up: set[str] = set()
        self._offsets_ns: dict[str, int] = {}

    def set_time_offset(self, stream: str, offset_ns: int) -> None:
        """From now on add ``offset_ns`` to the stamps of a stream, whose clock is not that of the frames."""
        self._offsets_ns[stream] = offset_ns

    def heard(self, stream: str, stamp_ns: int) -> None:
        """A message of a stream has come."""
        newest = self._newest.get(stream)
        self._newest[stream] = stamp_ns if newest is None else max(newest, stamp_ns)
        self._given_up.discard(stream)

    def frame(self, stamp_ns: int) -> None:
        """A frame has come; it may have to wait."""
        self._frames.append(stamp_ns)

    def forget(self, stream: str) -> None:
        """Forget what was heard of an expected stream: it is waited for anew."""
        self._newest[stream] = None
        self._given_up.discard(stream)

    def forget_frames(self) -> None:
        """Forget the frames that have come, so that none counts against a stream any more."""
        self._frames.clear()

    def must_wait(self, stamp_ns: int) -> bool:
        """True if a stream that is not silent has yet to reach the stamp."""
        return bool(self._missing(stamp_ns) - set(self.silent))

    def give_up(self, stamp_ns: int) -> tuple[str, ...]:
        """Stop waiting for what has not reached the stamp, until it is heard again; returns the streams given up.

        For a live node, whose frames may end as well: its own clock says when.
        """
        missing = self._missing(stamp_ns) - set(self.silent)
        self._given_up |= missing
        return tuple(sorted(missing))

    @property
    def silent(self) -> tuple[str, ...]:
        """Streams that nobody waits for, sorted."""
        return tuple(sorted(name for name, newest in self._newest.items() if self._is_silent(name, newest)))

    def diagnostic(self) -> str:
        """Names of the silent streams with their last stamps, or ""."""
        return "; ".join(f"no {name} {self._since(name)}" for name in self.silent)

    def _since(self, stream: str) -> str:
        newest = self._newest[stream]
        return "so far" if newest is None else f"since {newest / 1e9:.3f} s"

    def _missing(self, stamp_ns: int) -> set[str]:
        offset = self._offsets_ns
        return {n for n, newest in self._newest.items() if newest is None or newest + offset.get(n, 0) < stamp_ns}

    def _is_silent(self, name: str, newest: int | None) -> bool:
        if name in self._given_up:
            return True
        ahead = sum(newest is None or stamp > newest for stamp in self._frames)
        return ahead > self._patience
