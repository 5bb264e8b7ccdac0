# SPDX-License-Identifier: Apache-2.0
"""The colour pictures of a depth camera, found again by the stamps of its depth images."""

from __future__ import annotations

from collections import deque

from slam_core.types import ByteArray

TOLERANCE_NS = 20_000_000
"""A colour camera beside a depth camera has a clock of its own; in more time a moving camera looks elsewhere."""
_KEPT = 8


class RecentColours:
    """The newest pictures of one camera."""

    def __init__(self) -> None:
        self._pictures: deque[tuple[int, ByteArray]] = deque(maxlen=_KEPT)

    def __bool__(self) -> bool:
        return bool(self._pictures)

    def add(self, stamp_ns: int, picture: ByteArray) -> None:
        """Take a picture (h, w, 3) uint8."""
        self._pictures.append((stamp_ns, picture))

    def near(self, stamp_ns: int) -> ByteArray | None:
        """The picture nearest in time, or None if none is within the tolerance."""
        stamp, picture = min(self._pictures, key=lambda p: abs(p[0] - stamp_ns), default=(0, None))
        return picture if abs(stamp - stamp_ns) <= TOLERANCE_NS else None
