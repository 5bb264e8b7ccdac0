# SPDX-License-Identifier: Apache-2.0
"""Fuses observations to landmarks: pairs are fused one after the other, and no submap sees a landmark twice.

The observations of a landmark form a ring, each naming the next one, so that fusing two landmarks costs what these two
have been seen, however large the map is.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.linear_algebra.sparse_cholesky import IntArray

BoolArray = npt.NDArray[np.bool_]


def _none() -> IntArray:
    return np.empty(0, dtype=np.int64)


@dataclass
class Fusion:
    """Landmark of every observation (n,), named after its oldest one.

    The next observation of the same landmark, in a ring; and the submap that each observation belongs to.
    """

    landmark_of: IntArray = field(default_factory=_none)
    following: IntArray = field(default_factory=_none)
    record_of: IntArray = field(default_factory=_none)

    def append(self, count: int, record: int) -> None:
        """Observations of one more submap, each a landmark of its own."""
        alone = np.arange(len(self.landmark_of), len(self.landmark_of) + count)
        self.landmark_of = np.concatenate([self.landmark_of, alone])
        self.following = np.concatenate([self.following, alone])
        self.record_of = np.concatenate([self.record_of, np.full(count, record, dtype=np.int64)])

    def unite(self, pairs: IntArray) -> int:
        """Fuse pairs (k, 2) of observations in order, but for those that would let a submap see a landmark twice.

        The number of pairs that are one landmark now.
        """
        return int(_unite(pairs, self.landmark_of, self.following, self.record_of))

    def separate(self) -> None:
        """Every observation a landmark of its own again."""
        self.landmark_of = np.arange(len(self.landmark_of))
        self.following = self.landmark_of.copy()

    def copy(self) -> Fusion:
        """The same, to come back to; submaps do not change."""
        return Fusion(self.landmark_of.copy(), self.following.copy(), self.record_of)

    def is_shared(self) -> BoolArray:
        """Mask (n,) of observations whose landmark another submap sees too."""
        return np.asarray(self.following != np.arange(len(self.following)))


@njit(cache=True, nogil=True)
def _unite(pairs, landmark_of, following, record_of):
    seen = np.full(record_of[-1] + 1 if len(record_of) else 0, -1)
    united = 0
    for k in range(len(pairs)):
        a, b = landmark_of[pairs[k, 0]], landmark_of[pairs[k, 1]]
        keep, gone = min(a, b), max(a, b)
        if keep == gone:
            united += 1
            continue
        at = keep
        while True:
            seen[record_of[at]] = k
            at = following[at]
            if at == keep:
                break
        at, twice = gone, False
        while True:
            twice = twice or seen[record_of[at]] == k
            at = following[at]
            if at == gone:
                break
        if twice:
            continue
        while True:
            landmark_of[at] = keep
            at = following[at]
            if at == gone:
                break
        following[keep], following[gone] = following[gone], following[keep]
        united += 1
    return united
