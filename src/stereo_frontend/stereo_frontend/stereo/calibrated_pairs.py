# SPDX-License-Identifier: Apache-2.0
"""Holds stereo pairs back until both camera infos are known, so that the first frames of a recording are not lost."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

from slam_core.camera import CameraInfo
from slam_core.nodes.calibration_watch import same_calibration

T = TypeVar("T")
SIDES = ("left", "right")


class CalibratedPairs(Generic[T]):
    """Items that need the camera infos of both sides; at most ``depth`` wait, ``dropped`` counts the older ones."""

    def __init__(self, depth: int = 100) -> None:
        self.dropped = 0
        self._infos: dict[str, CameraInfo] = {}
        self._waiting: deque[T] = deque()
        self._depth = depth

    @property
    def infos(self) -> tuple[CameraInfo, CameraInfo] | None:
        """Left and right info; None until both are known."""
        return (self._infos["left"], self._infos["right"]) if len(self._infos) == len(SIDES) else None

    def set_info(self, side: str, info: CameraInfo) -> bool:
        """Take the info of "left" or "right"; whether it differs from the one known."""
        known = self._infos.get(side)
        if known is not None and same_calibration(known, info):
            return False
        self._infos[side] = info
        return True

    def add(self, item: T) -> None:
        """Take an item; :meth:`pop` returns it when its infos are there."""
        self._waiting.append(item)
        if self.infos is None and len(self._waiting) > self._depth:
            self._waiting.popleft()
            self.dropped += 1

    def pop(self) -> T | None:
        """The oldest item, if both infos are known and one waits."""
        return self._waiting.popleft() if self.infos is not None and self._waiting else None

    def clear(self) -> None:
        """Forget the items; calibrations stay."""
        self._waiting.clear()
