"""Brings stereo pairs and depth images of other stamps together, in the same way online and offline.

A pair waits until the depth camera has reached its stamp, then takes the nearest depth image. Only stamps decide, so
the order in which the two cameras' messages happen to arrive does not change the result. A depth camera that has fallen
silent holds nothing up for longer than ``patience`` pairs.
"""

from __future__ import annotations

from collections import deque

from slam_core.types import DepthImage, StereoImages

Paired = tuple[StereoImages, DepthImage | None]


class DepthPairing:
    """Queue of stereo pairs waiting for their depth image.

    Parameters
    ----------
    max_age
        Greatest difference of the stamps, s; a pair without such a depth image gets None.
    patience
        Pairs that may wait; beyond it the oldest goes on with what there is.
    """

    def __init__(self, max_age: float, patience: int = 10) -> None:
        self._max_age_ns = round(max_age * 1e9)
        self._patience = patience
        self._pairs: deque[StereoImages] = deque()
        self._depths: deque[DepthImage] = deque()

    def add_pair(self, images: StereoImages) -> list[Paired]:
        """Take a pair; returns what is complete, oldest first."""
        self._pairs.append(images)
        ready = self._complete()
        if len(self._pairs) > self._patience:
            ready.append(self._take())
        return ready

    def add_depth(self, depth: DepthImage) -> list[Paired]:
        """Take a depth image; returns what is complete, oldest first."""
        self._depths.append(depth)
        return self._complete()

    def flush(self) -> list[Paired]:
        """Everything that still waits, for the end of the input."""
        return [self._take() for _ in range(len(self._pairs))]

    def clear(self) -> None:
        """Forget everything."""
        self._pairs.clear()
        self._depths.clear()

    def _complete(self) -> list[Paired]:
        ready = []
        while self._pairs and self._depths and self._depths[-1].stamp_ns >= self._pairs[0].stamp_ns:
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
