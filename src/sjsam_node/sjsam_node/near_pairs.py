"""Which submaps the map says are near each other and have not been compared there yet.

A new submap is compared with the old ones around it where the map then believes it to be. Later closures move it, and
whole parts of the map that nothing tied together come to lie side by side: pairs that have become near, or have moved
against each other since they were compared in vain, are due again. What has been compared does not depend then on the
order in which submaps arrive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from sjsam_node.fusion import BoolArray
from sjsam_node.map_graph import MapGraph
from slam_core.geometry import FloatArray
from slam_core.sparse_cholesky import IntArray

Chain = Callable[[int], list[int]]
"""The records before one along its agent's odometry that it is linked to anyway."""


@dataclass
class NearPairs:
    """Pairs of records (first < second); ``compared``: where the second's middle was, seen from the first."""

    proximity: float
    neighbours: int
    moved: float
    compared: dict[tuple[int, int], FloatArray] = field(default_factory=dict)

    def note(self, graph: MapGraph, first: int, second: int) -> None:
        """Remember that two records are compared now."""
        first, second = sorted((first, second))
        self.compared[first, second] = _seen_from(graph, np.array([first]), np.array([second]))[0]

    def forget(self, records: set[int]) -> None:
        """These records are to be compared anew: what was believed of them is no longer."""
        self.compared = {pair: seen for pair, seen in self.compared.items() if records.isdisjoint(pair)}

    def due(self, graph: MapGraph, chain: Chain) -> list[tuple[int, int]]:
        """Pairs without a link, near in the map, that were not compared yet or lay elsewhere when they were; nearest
        first.
        """
        near = self._near(graph)
        linked = {(k.first, k.second) if k.first < k.second else (k.second, k.first) for k in graph.links}
        near = near[[pair not in linked for pair in map(tuple, near.tolist())]]
        due = near[~self._were_compared_here(graph, near)].tolist()
        return [(first, second) for first, second in due if first not in chain(second)]

    def _were_compared_here(self, graph: MapGraph, pairs: IntArray) -> BoolArray:
        """Whether each pair (k, 2) was compared where it lies now."""
        nowhere = np.full(3, np.inf)
        known = np.array([self.compared.get(pair, nowhere) for pair in map(tuple, pairs.tolist())]).reshape(-1, 3)
        return np.asarray(np.linalg.norm(_seen_from(graph, pairs[:, 0], pairs[:, 1]) - known, axis=1) < self.moved)

    def _near(self, graph: MapGraph) -> IntArray:
        """Every record with its nearest ones of the same component, (k, 2), the nearest pair first."""
        pairs, distances = [np.empty((0, 2), dtype=np.int64)], [np.empty(0)]
        for component in np.unique(graph.component_of).tolist():
            records = np.array(graph.records_of(component), dtype=np.int64)
            middles = graph.middles(records)
            count = [*range(2, min(len(records), self.neighbours + 1) + 1)]  # the first is the record itself
            if not count:
                continue
            distance, found = cKDTree(middles).query(middles, count, distance_upper_bound=self.proximity)
            row, column = np.nonzero(np.isfinite(distance))
            ends = np.stack([records[row], records[found[row, column]]], axis=1)
            pairs.append(np.sort(ends, axis=1))
            distances.append(distance[row, column])
        ends, gap = np.concatenate(pairs), np.concatenate(distances)
        ends, first = np.unique(ends, axis=0, return_index=True)
        return np.asarray(ends[np.argsort(gap[first], kind="stable")])


def _seen_from(graph: MapGraph, first: IntArray, second: IntArray) -> FloatArray:
    """Middles of the second records' landmarks in the first ones' start frames, (k, 3)."""
    T_map_first = graph.poses[graph.starts[first]]
    shift = graph.middles(second) - T_map_first[:, :3, 3]
    return np.asarray((np.swapaxes(T_map_first[:, :3, :3], 1, 2) @ shift[..., None])[..., 0])
