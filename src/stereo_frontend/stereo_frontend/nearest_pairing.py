# SPDX-License-Identifier: Apache-2.0
"""Brings frames and the depth images or masks that belong to them together, in the same way online and offline.

A frame waits until the other stream has reached its stamp, then takes what is nearest in time. Only stamps decide, so
the order in which the two streams' messages happen to arrive does not change the result. For a stream that has fallen
silent no frame waits, see :class:`slam_core.nodes.awaited_streams.AwaitedStreams`.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from slam_core.nodes.awaited_streams import PATIENCE, AwaitedStreams, Stamped

F = TypeVar("F", bound=Stamped)
C = TypeVar("C", bound=Stamped)

_KEPT = 40
"""Companions kept while no frame comes: a second and more of a camera at 30 Hz."""


class NearestPairing(Generic[F, C]):
    """Queue of frames waiting for their companions.

    Parameters
    ----------
    stream
        Name of the companions' stream.
    max_age
        Greatest difference of the stamps, s; a frame without such a companion gets None.
    expected
        Frames wait for it from the start; otherwise once it has been heard.
    patience
        Frames that may wait for it before it counts as silent.
    """

    def __init__(self, stream: str, max_age: float, *, expected: bool = True, patience: int = PATIENCE) -> None:
        self._stream = stream
        self._max_age_ns = round(max_age * 1e9)
        self._awaited = AwaitedStreams([stream] if expected else [], patience)
        self._frames: deque[F] = deque()
        self._companions: deque[C] = deque(maxlen=_KEPT)

    @property
    def diagnostic(self) -> str:
        """Since when the companions' stream is silent, or ""."""
        return self._awaited.diagnostic()

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits."""
        return self._frames[0].stamp_ns if self._frames else None

    def add_frame(self, frame: F) -> list[tuple[F, C | None]]:
        """Take a frame; returns what is complete, oldest first."""
        self._frames.append(frame)
        self._awaited.frame(frame.stamp_ns)
        return self._complete()

    def add_companion(self, companion: C) -> list[tuple[F, C | None]]:
        """Take a companion; returns what is complete, oldest first."""
        self._companions.append(companion)
        self._awaited.heard(self._stream, companion.stamp_ns)
        return self._complete()

    def give_up(self) -> list[tuple[F, C | None]]:
        """Everything that waits; later frames do not, until a companion comes."""
        if self._frames:
            self._awaited.give_up(self._frames[-1].stamp_ns)
        return self.flush()

    def flush(self) -> list[tuple[F, C | None]]:
        """Everything that still waits, for the end of the input."""
        return [self._take() for _ in range(len(self._frames))]

    def clear(self) -> None:
        """Forget everything."""
        self._frames.clear()
        self._companions.clear()
        self._awaited.clear()

    def _complete(self) -> list[tuple[F, C | None]]:
        ready = []
        while self._frames and not self._awaited.must_wait(self._frames[0].stamp_ns):
            ready.append(self._take())
        return ready

    def _take(self) -> tuple[F, C | None]:
        frame = self._frames.popleft()
        nearest = min(self._companions, key=lambda c: abs(c.stamp_ns - frame.stamp_ns), default=None)
        if nearest is not None and abs(nearest.stamp_ns - frame.stamp_ns) > self._max_age_ns:
            nearest = None
        while self._companions and self._companions[0].stamp_ns < frame.stamp_ns - self._max_age_ns:
            self._companions.popleft()
        return frame, nearest
