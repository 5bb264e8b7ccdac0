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

from sjsam_node.map_graph import MapGraph
from slam_core.geometry import FloatArray, invert_transform, transform_points

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
        self.compared[first, second] = _seen_from(graph, first, second)

    def due(self, graph: MapGraph, chain: Chain) -> list[tuple[int, int]]:
        """Pairs without a link, near in the map, that were not compared yet or lay elsewhere when they were; nearest
        first.
        """
        linked = {tuple(sorted((k.first, k.second))) for k in graph.links}
        near = sorted((distance, pair) for pair, distance in self._near(graph).items())
        return [
            pair
            for _, pair in near
            if pair not in linked and pair[0] not in chain(pair[1]) and not self._was_compared_here(graph, *pair)
        ]

    def _was_compared_here(self, graph: MapGraph, first: int, second: int) -> bool:
        known = self.compared.get((first, second))
        return known is not None and bool(np.linalg.norm(_seen_from(graph, first, second) - known) < self.moved)

    def _near(self, graph: MapGraph) -> dict[tuple[int, int], float]:
        """Every record with its nearest ones of the same component, and the distance of their middles, m."""
        pairs: dict[tuple[int, int], float] = {}
        for component in np.unique(graph.component_of).tolist():
            records = np.array(graph.records_of(component), dtype=np.int64)
            middles = graph.middles(records)
            count = [*range(2, min(len(records), self.neighbours + 1) + 1)]  # the first is the record itself
            if not count:
                continue
            distance, found = cKDTree(middles).query(middles, count, distance_upper_bound=self.proximity)
            for row, column in np.argwhere(np.isfinite(distance)).tolist():
                first, second = sorted((int(records[row]), int(records[found[row, column]])))
                pairs[first, second] = float(distance[row, column])
        return pairs


def _seen_from(graph: MapGraph, first: int, second: int) -> FloatArray:
    """Middle of the second record's landmarks in the first's start frame, (3,)."""
    T_first_map = invert_transform(graph.poses[graph.records[first].start])
    return np.asarray(transform_points(T_first_map, graph.middles(np.array([second])))[0])
