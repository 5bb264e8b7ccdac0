# SPDX-License-Identifier: Apache-2.0
"""Brings stereo pairs and depth images of other stamps together, in the same way online and offline.

A pair waits until the depth camera has reached its stamp, then takes the nearest depth image. Only stamps decide, so
the order in which the two cameras' messages happen to arrive does not change the result. For a depth camera that has
fallen silent no pair waits, see :class:`slam_core.nodes.awaited_streams.AwaitedStreams`.
"""

from __future__ import annotations

from collections import deque

from slam_core.nodes.awaited_streams import PATIENCE, AwaitedStreams
from slam_core.types import DepthImage, StereoImages

Paired = tuple[StereoImages, DepthImage | None]

_STREAM = "depth image"
_DEPTHS = 40
"""Depth images kept while no pair comes: a second and more of a camera at 30 Hz."""


class DepthPairing:
    """Queue of stereo pairs waiting for their depth image.

    Parameters
    ----------
    max_age
        Greatest difference of the stamps, s; a pair without such a depth image gets None.
    patience
        Pairs that may wait for the depth camera before it counts as silent.
    """

    def __init__(self, max_age: float, patience: int = PATIENCE) -> None:
        self._max_age_ns = round(max_age * 1e9)
        self._awaited = AwaitedStreams([_STREAM], patience)
        self._pairs: deque[StereoImages] = deque()
        self._depths: deque[DepthImage] = deque(maxlen=_DEPTHS)

    @property
    def complaint(self) -> str:
        """Since when the depth camera is silent, or ""."""
        return self._awaited.complaint()

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest pair that waits for a depth image."""
        return self._pairs[0].stamp_ns if self._pairs else None

    def add_pair(self, images: StereoImages) -> list[Paired]:
        """Take a pair; returns what is complete, oldest first."""
        self._pairs.append(images)
        self._awaited.frame(images.stamp_ns)
        return self._complete()

    def add_depth(self, depth: DepthImage) -> list[Paired]:
        """Take a depth image; returns what is complete, oldest first."""
        self._depths.append(depth)
        self._awaited.heard(_STREAM, depth.stamp_ns)
        return self._complete()

    def give_up(self) -> list[Paired]:
        """Everything that waits; later pairs do not, until a depth image comes."""
        if self._pairs:
            self._awaited.give_up(self._pairs[-1].stamp_ns)
        return self.flush()

    def flush(self) -> list[Paired]:
        """Everything that still waits, for the end of the input."""
        return [self._take() for _ in range(len(self._pairs))]

    def clear(self) -> None:
        """Forget everything."""
        self._pairs.clear()
        self._depths.clear()
        self._awaited.clear()

    def _complete(self) -> list[Paired]:
        ready = []
        while self._pairs and not self._awaited.must_wait(self._pairs[0].stamp_ns):
            ready.append(self._take())
        return ready

    def _take(self) -> Paired:
        pair = self._pairs.popleft()
        nearest = min(self._depths, key=lambda d: abs(d.stamp_ns - pair.stamp_ns), default=None)
        if nearest is not None and abs(nearest.stamp_ns - pair.stamp_ns) > self._max_age_ns:
            nearest = None
        while self._depths and self._depths[0].stamp_ns < pair.stamp_ns - self._max_age_ns:
            self._depths.popleft()
        return pair, nearest
