# SPDX-License-Identifier: Apache-2.0
"""Judges whether comparing two submaps can tell anything that the map does not know.

Where many laps or agents went, a new submap lies beside many old ones that see the same landmarks. Once it is linked to
one of them, those of its landmarks that the others see too are theirs already. Comparing it with these as well would
cost more with every lap and change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.links import Link
from sjsam_node.smoothing.state import EstimateState
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray


@dataclass
class RedundancyCheck:
    """Landmarks that submaps see by the map and by the links found so far, not in the map yet.

    enough: landmarks in common that tie two submaps. threshold: least scalar product of descriptors, and reach (m):
    largest distance, of two landmarks that may be the same.
    """

    state: EstimateState
    enough: int
    threshold: float
    reach: float
    _landmarks: dict[int, IntArray] = field(default_factory=dict)
    _poses: dict[int, FloatArray] = field(default_factory=dict)

    def note(self, link: Link) -> None:
        """Take a link as true: the second submap's landmarks are the first one's, and it is where the link says."""
        landmarks = self._seen(link.second).copy()
        landmarks[link.pairs[:, 1]] = self._seen(link.first)[link.pairs[:, 0]]
        self._landmarks[link.second] = landmarks
        self._poses[link.second] = self._pose(link.first) @ link.T

    def is_known(self, record: int) -> bool:
        """True if a link of this record to older ones was noted."""
        return record in self._poses

    def is_all_known(self, first: int, second: int) -> bool:
        """True if two submaps are tied already, and no others of their landmarks may be the same."""
        one, other = self._seen(first), self._seen(second)
        old, new = ~np.isin(one, other), ~np.isin(other, one)
        if len(new) - int(np.count_nonzero(new)) < self.enough:
            return False
        a, b = self.state.graph.records[first].submap, self.state.graph.records[second].submap
        i, j = np.nonzero(a.descriptors[old] @ b.descriptors[new].T >= self.threshold)
        T = invert_transform(self._pose(first)) @ self._pose(second)
        gap = a.landmarks[old][i] - transform_points(T, b.landmarks[new])[j]
        return not bool(np.any(np.einsum("ni,ni->n", gap, gap) < self.reach**2))

    def _seen(self, record: int) -> IntArray:
        known = self._landmarks.get(record)
        return self.state.graph.landmarks_of(record) if known is None else known

    def _pose(self, record: int) -> FloatArray:
        known = self._poses.get(record)
        return self.state.start(record) if known is None else known
