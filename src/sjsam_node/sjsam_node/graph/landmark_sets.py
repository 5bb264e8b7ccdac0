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


def no_indices() -> IntArray:
    """No numbers, (0,)."""
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LandmarkSets:
    """Landmark of every observation (n,), named after its oldest one.

    The next observation of the same landmark, in a ring; and the submap that each observation belongs to.
    """

    landmark_of: IntArray = field(default_factory=no_indices)
    following: IntArray = field(default_factory=no_indices)
    record_of: IntArray = field(default_factory=no_indices)

    def with_submap(self, count: int, record: int) -> LandmarkSets:
        """Sets with the observations of one more submap, each a landmark of its own."""
        alone = np.arange(len(self.landmark_of), len(self.landmark_of) + count)
        return LandmarkSets(
            np.concatenate([self.landmark_of, alone]),
            np.concatenate([self.following, alone]),
            np.concatenate([self.record_of, np.full(count, record, dtype=np.int64)]),
        )

    def united(self, pairs: IntArray) -> LandmarkSets:
        """Pairs (k, 2) of observations fused in order, but for those that would let a submap see a landmark twice."""
        landmark_of, following = self.landmark_of.copy(), self.following.copy()
        _unite(pairs, landmark_of, following, self.record_of)
        return LandmarkSets(landmark_of, following, self.record_of)

    def separated(self) -> LandmarkSets:
        """Every observation a landmark of its own again."""
        alone = np.arange(len(self.landmark_of))
        return LandmarkSets(alone, alone, self.record_of)

    @property
    def is_shared(self) -> BoolArray:
        """Mask (n,) of observations whose landmark another submap sees too."""
        return np.asarray(self.following != np.arange(len(self.following)))


@njit(cache=True, nogil=True)
def _unite(pairs, landmark_of, following, record_of):
    seen = np.full(record_of[-1] + 1 if len(record_of) else 0, -1)
    for k in range(len(pairs)):
        a, b = landmark_of[pairs[k, 0]], landmark_of[pairs[k, 1]]
        keep, gone = min(a, b), max(a, b)
        if keep == gone:
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
