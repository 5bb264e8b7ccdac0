# SPDX-License-Identifier: Apache-2.0
"""Pictures that colour the dense model: of a stereo pair, or of a colour camera, found again by their stamps."""

from __future__ import annotations

from collections import deque

import numpy as np

from slam_core.types import ByteArray, StereoImages

TOLERANCE_NS = 20_000_000
"""A colour camera beside a depth camera has a clock of its own; in more time a moving camera looks elsewhere."""
_KEPT = 8
NO_PICTURE: ByteArray = np.empty((0, 0, 3), dtype=np.uint8)
""":func:`~dense_mapping.keyframes.make_keyframe` takes it for a surface without colour."""


def stereo_picture(images: StereoImages, has_other_colours: bool) -> ByteArray:
    """The left image in colour, else in grey; of no size where another camera gives colours, between which grey blots.

    Shape (height, width, 3) or (height, width) uint8.
    """
    picture = images.picture()
    return NO_PICTURE if picture is images.left and has_other_colours else picture


class RecentColours:
    """The newest pictures of one camera."""

    def __init__(self) -> None:
        self._pictures: deque[tuple[int, ByteArray]] = deque(maxlen=_KEPT)
        self.newest_ns = -1
        """Stamp up to which pictures have come."""

    def add(self, stamp_ns: int, picture: ByteArray | None) -> None:
        """Take a picture (h, w, 3) uint8; None: there is none at this stamp."""
        self.newest_ns = stamp_ns
        if picture is not None:
            self._pictures.append((stamp_ns, picture))

    def near(self, stamp_ns: int) -> ByteArray | None:
        """The picture nearest in time, or None if none is within the tolerance."""
        stamp, picture = min(self._pictures, key=lambda p: abs(p[0] - stamp_ns), default=(0, None))
        return picture if abs(stamp - stamp_ns) <= TOLERANCE_NS else None
