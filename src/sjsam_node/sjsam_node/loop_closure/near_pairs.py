# SPDX-License-Identifier: Apache-2.0
"""Finds submaps that are near each other in the map and have not been compared there yet.

A new submap is compared with the old ones around it where the map then believes it to be. Later closures move it, and
whole parts of the map that nothing tied together come to lie side by side: pairs that have become near, or have moved
against each other since they were compared in vain, are due again. What has been compared does not depend then on the
order in which submaps arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from sjsam_node.smoothing.state import EstimateState
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.sparse_cholesky import IntArray

_SHIFT = 32
"""A pair is one number, the first record shifted by so many bits and the second, so that many are found at once."""


@dataclass
class Compared:
    """Pairs of records (first < second) that have been compared.

    Numbers (k,), ascending, and where the second's middle was when they were compared, seen from the first (k, 3).
    """

    codes: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    seen: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def of(cls, pairs: IntArray, seen: FloatArray) -> Compared:
        """From pairs (k, 2) and where each was seen (k, 3)."""
        codes = _codes(pairs)
        order = np.argsort(codes)
        return cls(codes[order], seen[order])

    @property
    def pairs(self) -> IntArray:
        """The pairs, (k, 2)."""
        return np.stack([self.codes >> _SHIFT, self.codes & ((1 << _SHIFT) - 1)], axis=1)

    def note(self, pair: IntArray, seen: FloatArray) -> None:
        """A pair (1, 2) is compared now, the second seen at (1, 3) from the first."""
        code = _codes(pair)
        at = np.searchsorted(self.codes, code)
        if at[0] < len(self.codes) and self.codes[at[0]] == code[0]:
            self.seen[at] = seen
        else:
            self.codes, self.seen = np.insert(self.codes, at, code), np.insert(self.seen, at, seen, axis=0)

    def forget(self, records: set[int]) -> None:
        """Leave out all pairs with one of the records."""
        kept = ~np.isin(self.pairs, list(records)).any(axis=1)
        self.codes, self.seen = self.codes[kept], self.seen[kept]

    def where(self, pairs: IntArray) -> FloatArray:
        """Places (k, 3) at which pairs (k, 2) were seen; infinitely far for one that was not compared."""
        codes = _codes(pairs)
        at = np.searchsorted(self.codes, codes)
        known = np.append(self.codes, -1)[at] == codes
        return np.where(known[:, None], np.append(self.seen, [[np.inf] * 3], axis=0)[at], np.inf)


def _codes(pairs: IntArray) -> IntArray:
    return np.asarray((pairs[:, 0] << _SHIFT) | pairs[:, 1])


@dataclass
class NearPairs:
    """Finds what is due; ``compared``: what was compared, and where."""

    proximity: float
    neighbours: int
    moved: float
    compared: Compared = field(default_factory=Compared)

    def note(self, state: EstimateState, first: int, second: int) -> None:
        """Remember that two records are compared now."""
        pair = np.sort(np.array([[first, second]], dtype=np.int64))
        self.compared.note(pair, _seen_from(state, pair[:, 0], pair[:, 1]))

    def forget(self, records: set[int]) -> None:
        """Compare these records anew: what was believed of them is no longer."""
        if records:
            self.compared.forget(records)

    def due(self, state: EstimateState, chained: IntArray) -> list[tuple[int, int]]:
        """Pairs without a link, near in the map, that were not compared yet or lay elsewhere when they were.

        Nearest first; none of those ``chained`` (n, 2) along the odometry of an agent.
        """
        near = self._near(state)
        tied = np.sort(np.concatenate([state.graph.linked, chained]), axis=1)
        near = near[~np.isin(_codes(near), _codes(tied))]
        gap = _seen_from(state, near[:, 0], near[:, 1]) - self.compared.where(near)
        due = near[np.linalg.norm(gap, axis=1) >= self.moved]
        return [(first, second) for first, second in due.tolist()]

    def _near(self, state: EstimateState) -> IntArray:
        """Every record with its nearest ones of the same component, (k, 2), the nearest pair first."""
        pairs, distances = [np.empty((0, 2), dtype=np.int64)], [np.empty(0)]
        for component in state.components():
            records = np.array(state.records_in(component), dtype=np.int64)
            records = records[~state.is_redundant(records)]
            middles = state.middles(records)
            count = [*range(2, min(len(records), self.neighbours + 1) + 1)]  # the first is the record itself
            if not count:
                continue
            distance, found = cKDTree(middles).query(middles, count, distance_upper_bound=self.proximity)
            row, column = np.nonzero(np.isfinite(distance))
            ends = np.stack([records[row], records[found[row, column]]], axis=1)
            pairs.append(np.sort(ends, axis=1))
            distances.append(distance[row, column])
        ends, gap = np.concatenate(pairs), np.concatenate(distances)
        _, first = np.unique(_codes(ends), return_index=True)
        return np.asarray(ends[first][np.argsort(gap[first], kind="stable")])


def _seen_from(state: EstimateState, first: IntArray, second: IntArray) -> FloatArray:
    """Middles of the second records' landmarks in the first ones' start frames, (k, 3)."""
    T_map_first = state.start_poses(first)
    shift = state.middles(second) - T_map_first[:, :3, 3]
    return np.asarray((np.swapaxes(T_map_first[:, :3, :3], 1, 2) @ shift[..., None])[..., 0])
