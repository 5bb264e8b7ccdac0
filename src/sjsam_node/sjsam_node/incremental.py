"""A component of the map graph that stays joined: what changed since the last time is found, and only that is redone.

A submap changes the problem by itself, and through the landmarks that it makes shared in others; so does a link that is
believed or taken back. All of them are local maps of a :class:`~sjsam_node.growing_problem.GrowingProblem`, which does
the rest.
"""

from __future__ import annotations

import copy

import numpy as np

from sjsam_node.estimator import Estimator, ReducedMap
from sjsam_node.growing_problem import GrowingProblem
from sjsam_node.map_graph import MapGraph
from sjsam_node.problem import LocalMap, State
from slam_core.geometry import FloatArray, make_transform
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig
from slam_core.sparse_cholesky import IntArray

_MOST_WASTED = 0.5
"""Share of the stored that may be out of date before all is built anew, in an order of less fill."""

_LEAST_GAIN = 1e-6
"""chi2 that moving a clique must gain: a move of a thousandth of its standard deviation waits for more."""
_SETTLED = 1e-4
"""Share of the tolerance to which :meth:`JoinedComponent.settle` goes."""


class JoinedComponent:
    """The joining problem of one component, factored, at its optimum after each :meth:`update`.

    Parameters
    ----------
    estimator
        Reduces the submaps.
    anchor
        Node that defines the component's frame.
    turn
        Submaps that turned by more (rad) since they were linearised are linearised anew.
    """

    def __init__(self, estimator: Estimator, anchor: int, turn: float) -> None:
        self.reduced: dict[int, ReducedMap] = {}
        self._estimator, self._anchor, self._turn = estimator, anchor, turn
        self._problem = GrowingProblem(anchor, turn)
        self._landmark_of = np.empty(0, dtype=np.int64)

    def copy(self) -> JoinedComponent:
        """The component as it is now; this one may go on."""
        other = copy.copy(self)
        other.reduced, other._problem = dict(self.reduced), self._problem.copy()
        return other

    @property
    def cost(self) -> float:
        """chi2."""
        return self._problem.cost

    @property
    def redundancy(self) -> int:
        """Rows beyond unknowns."""
        return self._problem.redundancy

    def covariance(self, nodes: list[int]) -> FloatArray:
        """Joint covariance (6k, 6k) of nodes."""
        return self._problem.covariance(np.array(nodes, dtype=np.int64))

    def update(self, graph: MapGraph, component: int, newest: int) -> LeastSquaresResult | None:
        """Bring the graph's estimate of the component to the optimum; ``newest`` is the record that it goes on from.

        None, and nothing is written, where steps from the estimate do not lead there, or the component is not the
        same any more: it needs a batch.
        """
        records = graph.records_of(component)
        if graph.oldest(component).start != self._anchor or not self.reduced.keys() <= set(records):
            return None
        if self._problem.wasted > _MOST_WASTED:
            self._problem, self.reduced = GrowingProblem(self._anchor, self._turn), {}
        is_shared = graph.shared()
        seen = np.where(is_shared, graph.landmark_of, -1)
        changed = self._changed(graph, records, seen)
        self._landmark_of = seen
        self.reduced.update({i: self._estimator.reduced(graph, i, is_shared) for i in changed})
        state = State(
            np.ascontiguousarray(graph.poses[:, :3, :3]), np.ascontiguousarray(graph.poses[:, :3, 3]), graph.points
        )
        record = graph.records[newest]
        self._problem.last = record.end, graph.landmark_of[record.observations]
        local = {i: self._local_map(graph, i) for i in changed}
        result, moved = self._problem.update(state, local, self._config(1.0), _LEAST_GAIN)
        if result.converged:
            self._write(graph, moved)
        return result if result.converged else None

    def settle(self, graph: MapGraph) -> None:
        """Go on until steps no longer move anything."""
        _, moved = self._problem.converge(self._config(_SETTLED))
        self._write(graph, moved)

    def _config(self, share: float) -> LevenbergMarquardtConfig:
        estimator = self._estimator.config
        return LevenbergMarquardtConfig(estimator.iterations, share * estimator.relative_tolerance)

    def _write(self, graph: MapGraph, moved: IntArray) -> None:
        state = self._problem.state
        graph.poses, graph.points = make_transform(state.rotations, state.translations), state.landmarks.copy()
        self._estimator.recover(graph, moved.tolist(), self.reduced)

    def _changed(self, graph: MapGraph, records: list[int], seen: IntArray) -> list[int]:
        """Records that are new, or of which a landmark is seen elsewhere now, or not any more."""
        first = np.array([r.first_observation for r in graph.records])
        different = np.nonzero(seen[: len(self._landmark_of)] != self._landmark_of)[0]
        of_different = set((np.searchsorted(first, different, side="right") - 1).tolist())
        return [i for i in records if i not in self.reduced or i in of_different]

    def _local_map(self, graph: MapGraph, i: int) -> LocalMap:
        record, reduced = graph.records[i], self.reduced[i]
        landmarks = graph.landmark_of[record.observations[reduced.shared]]
        return LocalMap(record.start, np.array([record.end]), landmarks, reduced.mean, reduced.information)
