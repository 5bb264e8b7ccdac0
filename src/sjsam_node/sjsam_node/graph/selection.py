# SPDX-License-Identifier: Apache-2.0
"""Selects which of the landmarks that submaps share tie them together in the estimate.

A few dozen well spread landmarks say nearly all that two submaps can say of each other's pose. The others are the same
landmarks of the map all the same, but stay marginalised in their submaps (a Gaussian's rows are dropped, which is exact
and counts nothing twice), so that the estimate does not grow with all that is seen again.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from slam_core.linear_algebra.block_pattern import IntArray


def _no_pairs() -> IntArray:
    return np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class LinkedPairs:
    """Matched observations of links, one link after the other.

    pairs (k, 2) of observations, ptr (n + 1,) where those of each link start, ends (n, 2): the records it links.
    """

    pairs: IntArray = field(default_factory=_no_pairs)
    ptr: IntArray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    ends: IntArray = field(default_factory=_no_pairs)

    def followed_by(self, later: LinkedPairs) -> LinkedPairs:
        """Pairs of both, ``later`` last."""
        return LinkedPairs(
            np.concatenate([self.pairs, later.pairs]), np.append(self.ptr, self.ptr[-1] + later.ptr[1:]),
            np.concatenate([self.ends, later.ends]),
        )  # fmt: skip


@njit(cache=True, nogil=True)
def spread_order(points):
    """Rank (n,) of each of some points (n, 3): the first ones of the order lie as far apart as they can."""
    n = len(points)
    rank = np.zeros(n, np.int64)
    if n == 0:
        return rank
    distance = np.full(n, np.inf)
    taken = np.zeros(n, np.bool_)
    at = 0
    for k in range(n):
        rank[at] = k
        taken[at] = True
        best = -1.0
        following = at
        for i in range(n):
            if taken[i]:
                continue
            gap = 0.0
            for p in range(3):
                gap += (points[i, p] - points[at, p]) ** 2
            if gap < distance[i]:
                distance[i] = gap
            if distance[i] > best:
                best, following = distance[i], i
        at = following
    return rank


@njit(cache=True, nogil=True)
def variables(pairs, link_ptr, count, landmark_of, rank):
    """The variable that each observation (n,) is of: one for those of a landmark that tie links, else its own.

    ``pairs`` (k, 2) of observations, those of link i from ``link_ptr[i]`` on, of which ``count[i]`` tie it: the first
    ones by the ``rank`` of their landmark, so that the same landmarks tie one submap to all others.
    """
    n = len(landmark_of)
    variable = np.arange(n)
    ties = np.zeros(n, np.bool_)
    for link in range(len(count)):
        first, last = link_ptr[link], link_ptr[link + 1]
        chosen = np.arange(first, last)
        if count[link] < last - first:
            keys = np.empty(last - first, np.int64)
            for k in range(first, last):
                keys[k - first] = rank[landmark_of[pairs[k, 0]]]
            chosen = first + np.argsort(keys, kind="mergesort")[: count[link]]
        for k in chosen:
            a, b = pairs[k, 0], pairs[k, 1]
            if landmark_of[a] == landmark_of[b]:
                ties[a] = True
                ties[b] = True
    oldest = np.full(n, -1)
    for i in range(n):
        if ties[i]:
            landmark = landmark_of[i]
            if oldest[landmark] < 0:
                oldest[landmark] = i
            variable[i] = oldest[landmark]
    return variable
