# SPDX-License-Identifier: Apache-2.0
"""Masks of people and other things that move: what lies in them does not become part of the dense model."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from dense_mapping.colours import TOLERANCE_NS
from dense_mapping.keyframes import Keyframe
from slam_core.types import ByteArray, Mask
from stereo_frontend.masks import widened

_KEPT = 40
"""Masks kept of one camera: a second and more at 30 Hz."""
_MARGIN_PX = 8
"""Depth beside a mask's areas is that of their edge, px."""


class RecentMasks:
    """The newest masks of one camera."""

    def __init__(self) -> None:
        self._masks: deque[Mask] = deque(maxlen=_KEPT)
        self.newest_ns = -1
        """Stamp up to which masks have come."""

    def add(self, mask: Mask) -> None:
        """Take a mask, in the order of the stamps."""
        self.newest_ns = mask.stamp_ns
        self._masks.append(mask)

    def at(self, stamp_ns: int) -> ByteArray | None:
        """Pixels of the mask nearest in time, or None if none is within the tolerance."""
        nearest = min(self._masks, key=lambda mask: abs(mask.stamp_ns - stamp_ns), default=None)
        return None if nearest is None or abs(nearest.stamp_ns - stamp_ns) > TOLERANCE_NS else nearest.pixels


def masked(keyframe: Keyframe, mask: ByteArray) -> Keyframe:
    """The key frame without depth where a mask (height, width) of its image, before that was thinned, is not zero.

    Raises
    ------
    ValueError
        For a mask that is not of the image's size.
    """
    shape, spacing = keyframe.depth_units.shape, 1
    while -(-mask.shape[0] // spacing) > shape[0]:
        spacing *= 2
    hidden = widened(mask, _MARGIN_PX)[::spacing, ::spacing] != 0
    if hidden.shape != shape:
        raise ValueError(
            f"a mask of {mask.shape[1]} x {mask.shape[0]} px is not of an image thinned to {shape[::-1]} px"
        )
    depth, sigma = keyframe.depth_units.copy(), keyframe.sigma_units.copy()
    depth[hidden], sigma[hidden] = 0, 0
    return replace(keyframe, depth_units=depth, sigma_units=sigma)
