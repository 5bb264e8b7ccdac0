"""Keeps every component of a map graph at its optimum as submaps, links and doubts come in.

A submap that only continues its agent's path is joined through the front (:mod:`sjsam_node.incremental`); everything
else, closures above all, is joined in batch, warm from the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.association import Prior, variance_factor
from sjsam_node.closures import prior_of_pair, relative_pose
from sjsam_node.estimator import Assembled, Estimator, EstimatorConfig, local_residual, observation_nis
from sjsam_node.incremental import Front
from sjsam_node.map_graph import Link, MapGraph, without
from slam_core.config import Config, group, parameter
from slam_core.geometry import compose_covariance
from slam_core.least_squares import chi_square_bound
from slam_core.sparse_cholesky import IntArray


@dataclass(frozen=True)
class JoinerConfig(Config):
    """When the map is joined how, and what it takes back."""

    incremental_from: int = parameter(
        40, "submaps of a component from which on they are joined incrementally; below, batch costs no more", minimum=2
    )
    relinearize_turn: float = parameter(
        0.02, "turn of a pose, since it was linearised, that calls for a batch", unit="rad", minimum=0.0
    )
    outlier_probability: float = parameter(
        0.99999, "share of true matches that a joined map keeps", minimum=0.9, maximum=0.99999999
    )
    outlier_rounds: int = parameter(5, "times a joined map is searched for false matches", minimum=0)
    closure_probability: float = parameter(
        0.9999, "share of true closures whose rise of chi2 is accepted", minimum=0.9, maximum=0.9999999
    )
    estimator: EstimatorConfig = group(EstimatorConfig)


@dataclass(frozen=True, eq=False)
class JoinResult:
    """chi2 of the component, iterations, whether it converged, solver, and ``batch`` or ``incremental``."""

    cost: float
    iterations: int
    converged: bool
    solver: str
    update: str


@dataclass(frozen=True, eq=False)
class _Joined:
    """A component: the last batch, what was added since, and the front that it is added to.

    ``extensible``: the batch kept what a front needs.
    """

    assembled: Assembled
    result: JoinResult
    newest: int
    window: IntArray
    extensible: bool = False
    front: Front | None = None
    added: int = 0


@dataclass
class Joiner:
    """The estimate of a graph; ``window`` is how many submaps back a new one may be linked."""

    graph: MapGraph
    window: int
    config: JoinerConfig = field(default_factory=JoinerConfig)
    estimator: Estimator = field(init=False)
    _joined: dict[int, _Joined] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.estimator = Estimator(self.config.estimator)

    def absorb(self, new: int, chain: list[int]) -> JoinResult:
        """Join record ``new``, whose links to its ``chain`` have been added to the graph."""
        window = self._window_landmarks([new, *chain[: self.window - 1]])
        extended = self._extended(new, window)
        if extended is None:
            going_on = self.graph.size(self.graph.component(new)) >= self.config.incremental_from
            return self.batch(new, window, extensible=going_on)
        self._joined[self.graph.component(new)] = extended
        return extended.result

    def _extended(self, new: int, window: IntArray) -> _Joined | None:
        """The component with one more submap joined through the front; None where that is not possible."""
        component, record = self.graph.component(new), self.graph.records[new]
        joined = self._joined.get(component)
        if joined is None or not joined.extensible:
            return None
        if self.graph.records[joined.newest].end != record.start:
            return None
        try:
            front, fusion = (joined.front or self._front(joined)).fused(self.graph.landmark_of)
            seen = self.graph.landmark_of[record.observations]
            if not np.all(np.isin(seen, front.landmarks) | (seen >= record.first_observation)):
                return None
            front, rise, turn = front.extended(self.graph, record, window, self.config.estimator.rows)
        except (ValueError, np.linalg.LinAlgError):  # badly conditioned: batch damps
            return None
        if turn > self.config.relinearize_turn:
            return None
        result = replace(joined.result, cost=joined.result.cost + fusion + rise, iterations=1, update="incremental")
        return replace(joined, result=result, newest=new, window=window, front=front, added=joined.added + 1)

    def batch(self, newest: int, window: IntArray | None = None, *, extensible: bool = False) -> JoinResult:
        """Join the whole component of a record, whose end is where it will go on.

        ``extensible`` keeps the landmarks of the window even where one submap alone saw them, so that the next submap
        can be joined through a front; it makes the problem larger, so trials do without.
        """
        component = self.graph.component(newest)
        if window is None:
            known = self._joined.get(component)
            window = known.window if known is not None and known.newest == newest else self._window_landmarks([newest])
            window = np.unique(self.graph.landmark_of[window])
        front = (self.graph.records[newest].end, window) if extensible else None
        assembled, result = self.estimator.optimize(self.graph, component, front)
        report = JoinResult(result.cost, result.iterations, result.converged, assembled.problem.backend, "batch")
        self._joined[component] = _Joined(assembled, report, newest, window, extensible)
        return report

    def _front(self, joined: _Joined) -> Front:
        return Front.of(self.graph, joined.assembled, self.graph.records[joined.newest].end, joined.window)

    def _window_landmarks(self, records: list[int]) -> IntArray:
        return np.unique(np.concatenate([self.graph.landmark_of[self.graph.records[i].observations] for i in records]))

    def assembled(self, component: int) -> Assembled:
        """The joining problem of a component with everything in it."""
        joined = self._joined.get(component)
        if joined is None:  # a map that was just loaded is at its optimum already
            newest = int(self.graph.records_of(component)[-1])
            window = self._window_landmarks([newest])
            assembled = self.estimator.assemble(self.graph, component)
            cost = assembled.problem.cost(assembled.state)
            report = JoinResult(cost, 0, True, assembled.problem.backend, "batch")
            self._joined[component] = joined = _Joined(assembled, report, newest, window)
        if joined.added:
            self.batch(joined.newest)
        return self._joined[component].assembled

    def cost(self, component: int) -> float:
        """chi2 of a component."""
        if component not in self._joined:
            self.assembled(component)
        return self._joined[component].result.cost

    def variance_factor(self, component: int) -> float:
        """chi2 per degree of freedom: how much larger the errors of a component's submaps are than they claim.

        Never below one: submaps that agree better than they should are not made surer.
        """
        problem = self.assembled(component).problem
        redundancy = problem.rows - problem.layout.pattern.n
        return max(1.0, self.cost(component) / redundancy) if redundancy > 0 else 1.0

    # -- closures ------------------------------------------------------------------------------------------------------

    def relative_pose(self, first: int, second: int) -> Prior | None:
        """What the map knows of T_first_second (starts of two records, the second one the newer); None across
        components. Submaps added since the last batch count with their odometry alone, which is never too sure.
        """
        graph = self.graph
        component = graph.component(first)
        if component != graph.component(second):
            return None
        if component not in self._joined:
            self.assembled(component)
        nodes, start = self._joined[component].assembled.nodes, graph.records[first].start
        node, T, covariance = graph.records[second].start, np.eye(4), np.zeros((6, 6))
        while node not in nodes and node != start:
            submap = graph.records[graph.record_ending_at(node)].submap
            covariance = compose_covariance(submap.end_pose, submap.covariance[:6, :6], T, covariance)
            T = submap.end_pose @ T
            node = graph.records[graph.record_ending_at(node)].start
        if start not in nodes:
            return None if node != start else prior_of_pair(T, covariance)
        joint = self._joined[component].assembled.covariance([start, node])
        T_known, known = relative_pose(graph.poses[start], graph.poses[node], joint)
        return prior_of_pair(T_known @ T, compose_covariance(T_known, known, T, covariance))

    def try_links(self, links: list[Link], newest: int) -> bool:
        """Join with some links; keep them if chi2 rises no more than true matches make it rise.

        ``newest`` is the record whose end the agent goes on from.
        """
        graph = self.graph
        parts = {graph.component(i) for link in links for i in (link.first, link.second)}
        cost = sum(self.cost(part) for part in parts)
        dof = sum(3 * len(link.pairs) for link in links) - 6 * (len(parts) - 1)
        before, known = graph.snapshot(), dict(self._joined)
        for link in links:
            graph.add_link(link)
        after = self.batch(newest)
        # Closures that contradict the covariances, but not the drift to expect, bend the map once for all of them.
        tension = max(link.tension for link in links)
        excess = self._excess(after.cost - cost - tension, dof, graph.component(newest))
        if excess <= 0.0:
            for part in parts - {graph.component(newest)}:
                self._joined.pop(part, None)
            return True
        graph.restore(before)
        self._joined = known
        return False

    def _excess(self, rise: float, dof: int, component: int) -> float:
        """How far chi2 rose above what true matches explain. Submaps that are too sure of themselves make every
        closure look bad: the bound is in units of the map's own variance factor (Baarda 1968), never below one.
        """
        problem = self._joined[component].assembled.problem
        free = max(problem.rows - problem.layout.pattern.n, 1)
        factor = max(1.0, (self._joined[component].result.cost - max(rise, 0.0)) / free)
        return float(rise - factor * chi_square_bound(self.config.closure_probability, max(dof, 1)))

    def drop_outliers(self, newest: int) -> int:
        """Take back matches that the joined map contradicts, worst first; the number taken back."""
        dropped = 0
        for _ in range(self.config.outlier_rounds):
            outliers = self._outliers(self.graph.component(newest))
            if not outliers:
                break
            dropped += len(outliers)
            kept = [without(self.graph, link, outliers) for link in self.graph.links]
            self.graph.replace_links([link for link in kept if link is not None])
            self._joined = {c: j for c, j in self._joined.items() if c == self.graph.component(j.newest)}
            self.batch(newest)
        return dropped

    def _outliers(self, component: int) -> set[int]:
        """The worst observation of each record, where it is beyond its gate."""
        assembled = self._joined[component].assembled
        found = [
            (
                i,
                reduced,
                observation_nis(local_residual(self.graph, self.graph.records[i], reduced), reduced.information),
            )
            for i, reduced in zip(assembled.records, assembled.reduced, strict=True)
        ]
        factor = variance_factor(np.concatenate([nis for _, _, nis in found]))
        gate = factor * chi_square_bound(self.config.outlier_probability, 3)
        return {
            int(self.graph.records[i].observations[reduced.shared[nis.argmax()]])
            for i, reduced, nis in found
            if nis.max(initial=0.0) > gate
        }
