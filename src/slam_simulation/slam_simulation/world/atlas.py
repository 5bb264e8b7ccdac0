# SPDX-License-Identifier: Apache-2.0
"""Texture atlas: every texture with its mip chain in one flat byte array, ready for the compiled sampler.

A texture is a grey image of reflectance, 0 to 255 for 0 to 1, with sides that are powers of two. The mip chain
(Williams 1983) halves both sides down to one texel, so that a pixel that covers many texels reads their mean instead
of one of them: features then move with the surface, as in a real image, and do not sparkle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import ByteArray


class TextureTable(NamedTuple):
    """Textures as the kernels read them: ``texels`` flat uint8.

    ``entries`` int64 (n, 4) = offset, log2 width, log2 height, clamp.
    """

    texels: ByteArray
    entries: npt.NDArray[np.int64]


class TextureAtlas:
    """Collects textures under names; each is made once."""

    def __init__(self) -> None:
        self._chains: list[ByteArray] = []
        self._index: list[tuple[int, int, int, int]] = []
        self._ids: dict[str, int] = {}
        self._size = 0

    def __contains__(self, name: str) -> bool:
        return name in self._ids

    def __getitem__(self, name: str) -> int:
        return self._ids[name]

    def add(self, name: str, image: FloatArray, *, clamp: bool) -> int:
        """Number of the texture of reflectance ``image`` (h, w) in [0, 1].

        ``clamp`` for pictures, False for patterns.
        """
        bytes_ = np.clip(np.round(image * 255.0), 0, 255).astype(np.uint8)
        height, width = bytes_.shape
        if height & (height - 1) or width & (width - 1):
            raise ValueError(f"texture '{name}' must have sides that are powers of two, got {width} x {height}")
        chain = mip_chain(bytes_)
        self._index.append((self._size, int(math.log2(width)), int(math.log2(height)), int(clamp)))
        self._chains.append(chain)
        self._size += len(chain)
        self._ids[name] = len(self._index) - 1
        return self._ids[name]

    def table(self) -> TextureTable:
        """The arrays for the kernels."""
        return TextureTable(np.concatenate(self._chains), np.array(self._index, dtype=np.int64))


def mip_chain(image: ByteArray) -> ByteArray:
    """All levels of ``image``, finest first, flattened one after the other; a side that has reached one texel stays."""
    levels, level = [image.ravel()], image.astype(np.float32)
    while max(level.shape) > 1:
        height, width = level.shape
        size = (max(width // 2, 1), max(height // 2, 1))
        level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_AREA), dtype=np.float32).reshape(size[::-1])
        levels.append(np.round(level).astype(np.uint8).ravel())
    return np.concatenate(levels)
