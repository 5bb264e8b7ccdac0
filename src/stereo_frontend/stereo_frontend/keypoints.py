# SPDX-License-Identifier: Apache-2.0
"""Keypoints of one image and their spread over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from slam_core.types import AnyArray, ByteArray, Float32Array

MOST_KEYPOINTS = 20000
"""Keypoints of one image that a detector has room for."""

Selector = Callable[[Float32Array, Float32Array, Float32Array], npt.NDArray[np.intp]]
"""Chooses keypoints: (uv (n, 2) px, size (n,) px, response (n,)) to the indices kept, in their final order."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """uv (n, 2) px; size (n,) px, diameter of the region described; response (n,); descriptors (n, d), unit norm."""

    uv: Float32Array
    size: Float32Array
    response: Float32Array
    descriptors: Float32Array

    def __len__(self) -> int:
        return len(self.uv)

    def select(self, index: AnyArray) -> Keypoints:
        """The keypoints at ``index`` (mask or indices)."""
        return Keypoints(self.uv[index], self.size[index], self.response[index], self.descriptors[index])

    @staticmethod
    def none(dimension: int = 128) -> Keypoints:
        """No keypoints at all."""
        empty = np.zeros(0, np.float32)
        return Keypoints(np.zeros((0, 2), np.float32), empty, empty, np.zeros((0, dimension), np.float32))


class Detector(Protocol):
    """Finds and describes keypoints."""

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Keypoints of ``image`` above ``threshold``, thinned out by ``select``.

        A threshold of 1.0 is the detector's customary one.
        """
        ...

    def describe(self, image: ByteArray, keypoints: Keypoints) -> Keypoints:
        """Keypoints of ``image`` described for other moments', where they were so for a stereo partner's only."""
        ...


class DescribesAtOnce:
    """A detector whose keypoints come with descriptors for every purpose."""

    def describe(self, image: ByteArray, keypoints: Keypoints) -> Keypoints:
        """Keypoints as they are: they are described already."""
        return keypoints


def spread_over_grid(
    uv: Float32Array, response: Float32Array, shape: tuple[int, int], grid: tuple[int, int], target: int
) -> npt.NDArray[np.intp]:
    """Indices of at most ``target`` keypoints: the best of every cell first, then every cell's second, and so on.

    Parameters
    ----------
    uv, response
        Pixels (n, 2) and strength (n,).
    shape
        Height and width of the image, px.
    grid
        Rows and columns of cells.
    target
        Number of keypoints kept at most.
    """
    rows, columns = grid
    row = np.clip((uv[:, 1] * (rows / shape[0])).astype(np.int16), 0, rows - 1)
    column = np.clip((uv[:, 0] * (columns / shape[1])).astype(np.int16), 0, columns - 1)
    cell = row * columns + column
    strongest = np.argsort(-response)
    sorted_response = response[strongest]
    if np.any(sorted_response[1:] == sorted_response[:-1]):
        strongest = np.lexsort((uv[:, 0], uv[:, 1], cell, -response))
    by_cell = np.argsort(cell[strongest], kind="stable")
    sorted_cell = cell[strongest][by_cell]
    rank = np.empty(len(by_cell), np.int16)
    rank[by_cell] = np.arange(len(by_cell)) - np.searchsorted(sorted_cell, sorted_cell)
    return strongest[np.argsort(rank, kind="stable")[:target]]
