# SPDX-License-Identifier: Apache-2.0
"""Masks: pixels of a rectified image in which no features are wanted, of people for instance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.nodes.awaited_streams import PATIENCE
from slam_core.types import AnyArray, ByteArray, Counters, DepthImage, Mask, StereoImages
from stereo_frontend.nearest_pairing import NearestPairing


@dataclass(frozen=True)
class MaskingConfig(Config):
    """Masks of what moves, from a detector that the user has."""

    use: str = parameter(
        "auto",
        "frames wait for their masks once there are any, from the first frame on, or take none",
        choices=("auto", "always", "never"),
    )
    max_age: float = parameter(
        0.1, "a frame without a mask of its own stamp takes the nearest within this time", unit="s", minimum=0.0
    )
    margin: int = parameter(8, "masks are widened by so much: features have an extent", unit="px", minimum=0)
    patience: int = parameter(
        PATIENCE, "frames that may wait for a mask before they go on without", unit="frames", minimum=1
    )


class Masking:
    """Gives stereo pairs, or the depth images of a camera alone, their masks; without one they go on as they are.

    ``counters``: frames with a mask, frames without one that should have had it, and masks of another size.
    """

    def __init__(self, config: MaskingConfig) -> None:
        self._config = config
        self._pairing = NearestPairing[StereoImages | DepthImage, Mask](
            "mask", config.max_age, expected=config.use == "always", patience=config.patience
        )
        self.counters = Counters()
        self._wrong_size = ""

    @property
    def diagnostic(self) -> str:
        """Complaint about a mask of the wrong size, or since when there are no masks, or ""."""
        return self._wrong_size or self._pairing.diagnostic

    @property
    def oldest_waiting_ns(self) -> int | None:
        """Stamp of the oldest frame that waits for its mask."""
        return self._pairing.oldest_waiting_ns

    def add_frame(self, frame: StereoImages | DepthImage) -> list[StereoImages | DepthImage]:
        """Take a frame; returns the frames that are ready, oldest first."""
        return [frame] if self._config.use == "never" else self._masked(self._pairing.add_frame(frame))

    def add_mask(self, mask: Mask) -> list[StereoImages | DepthImage]:
        """Take a mask; returns the frames that are ready, oldest first."""
        if self._config.use == "never":
            return []
        self.counters.add("masks")
        return self._masked(self._pairing.add_companion(mask))

    def give_up(self) -> list[StereoImages | DepthImage]:
        """All frames that wait; later ones do not, until a mask comes."""
        return self._masked(self._pairing.give_up())

    def flush(self) -> list[StereoImages | DepthImage]:
        """All frames that wait, at the end of the input."""
        return self._masked(self._pairing.flush())

    def clear(self) -> None:
        """Forget what waits."""
        self._pairing.clear()

    def _masked(self, pairs: list[tuple[StereoImages | DepthImage, Mask | None]]) -> list[StereoImages | DepthImage]:
        return [self._with_mask(frame, mask) for frame, mask in pairs]

    def _with_mask(self, frame: StereoImages | DepthImage, mask: Mask | None) -> StereoImages | DepthImage:
        if mask is None:
            if self.counters.counts.get("masks"):
                self.counters.add("frames_without_mask")
            return frame
        shape = frame.left.shape if isinstance(frame, StereoImages) else frame.depth.shape
        if mask.pixels.shape != shape:
            self.counters.add("masks_of_another_size")
            self._wrong_size = f"masks are {_size(mask.pixels.shape)}, the rectified images {_size(shape)}: not used"
            return frame
        self._wrong_size = ""
        self.counters.add("frames_masked")
        return replace(frame, mask=widened(mask.pixels, self._config.margin))


def widened(pixels: ByteArray, margin: int) -> ByteArray:
    """A mask (height, width) that also covers what is within ``margin`` px, along rows and columns, of its areas."""
    side = 2 * margin + 1
    return np.asarray(cv2.dilate(np.ascontiguousarray(pixels), np.ones((side, side), np.uint8)), np.uint8)


def is_masked(mask: ByteArray | None, uv: AnyArray) -> npt.NDArray[np.bool_]:
    """True for the pixels (n, 2) that lie in a mask's areas; not for those that are outside or not finite."""
    if mask is None:
        return np.zeros(len(uv), bool)
    at = np.rint(np.nan_to_num(uv, nan=-1.0)).astype(np.int64)
    inside = ((at >= 0) & (at < mask.shape[::-1])).all(axis=1)
    return np.asarray(inside & (mask[at[:, 1] * inside, at[:, 0] * inside] != 0))


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]} px"
