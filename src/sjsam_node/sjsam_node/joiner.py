"""Keeps every component of a map graph at its optimum as submaps, links and doubts come in.

A submap that only continues its agent's path is joined through the front (:mod:`sjsam_node.incremental`) where that is
less work; everything else, closures above all, is joined in batch, warm from the estimate and with the regions closed
that nothing new touches (:mod:`sjsam_node.regions`). There is one front: where several agents take
turns, the submaps of the others follow their odometry until the next batch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.association import Prior
from sjsam_node.closures import prior_of_pair, relative_pose
from sjsam_node.estimator import Assembled, Estimator, EstimatorConfig
from sjsam_node.incremental import Front
from sjsam_node.map_graph import MapGraph, Snapshot
from sjsam_node.regions import Region, RegionConfig, Regions
from slam_core.config import Config, group, parameter
from slam_core.geometry import compose_covariance
from slam_core.linear_algebra.sparse_cholesky import IntArray


@dataclass(frozen=True)
class JoinerConfig(Config):
    """When the map is joined how, and what it takes back."""

    incremental_from: int = parameter(40, "fewest submaps of a component that is joined incrementally", minimum=2)
    front_work: float = parameter(
        0.25, "largest work of factoring a front, over that of a batch, for joining incrementally", minimum=0.0
    )
    relinearize_turn: float = parameter(
        0.02, "turn of a pose, since it was linearised, that calls for a batch", unit="rad", minimum=0.0
    )
    estimator: EstimatorConfig = group(EstimatorConfig)
    region: RegionConfig = group(RegionConfig)


@dataclass(frozen=True, eq=False)
class JoinResult:
    """chi2 of the component, iterations, whether it converged, solver; ``batch``, ``incremental`` or ``odometry``."""

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


def _clique_work(landmarks: IntArray) -> float:
    """Multiplications of factoring the front of a pose and landmarks."""
    return float((6.0 + 3.0 * len(landmarks)) ** 3 / 6.0)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Beliefs, estimate and what was joined at one time."""

    graph: Snapshot
    joined: dict[int, _Joined]
    regions: tuple[Region, ...]


@dataclass
class Joiner:
    """The estimate of a graph; ``window`` is how many submaps back a new one may be linked."""

    graph: MapGraph
    window: int
    config: JoinerConfig = field(default_factory=JoinerConfig)
    estimator: Estimator = field(init=False)
    regions: Regions = field(init=False)
    _joined: dict[int, _Joined] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.estimator = Estimator(self.config.estimator)
        self.regions = Regions(self.estimator.local_maps, self.config.region)

    def absorb(self, new: int, chain: list[int]) -> JoinResult:
        """Join record ``new``, whose links to its ``chain`` have been added to the graph."""
        window = self._window_landmarks([new, *chain[: self.window - 1]])
        if self.config.estimator.linearises:
            self.regions.close(self.graph, self.graph.component(new), {new, *chain})
        extended = self._put_off(new) or self._extended(new, window)
        if extended is None:
            return self.batch(new, window)
        self._joined[self.graph.component(new)] = extended
        return extended.result

    def _put_off(self, new: int) -> _Joined | None:
        """The component with a submap of an agent whose end is not the front: its odometry places it until the next
        batch. Agents that take turns would otherwise call for a batch each time.
        """
        joined = self._joined.get(self.graph.component(new))
        if joined is None or not joined.extensible:
            return None
        if self.graph.records[joined.newest].end == self.graph.records[new].start:
            return None
        result = replace(joined.result, iterations=0, update="odometry")
        return replace(joined, result=result, added=joined.added + 1)

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

    def batch(self, newest: int, window: IntArray | None = None, *, whole: bool = False) -> JoinResult:
        """Join the component of a record, whose end is where it will go on; regions stay closed unless it is to be
        joined as a ``whole``.

        Where the next submap is joined with less work through a front than in batch, the landmarks of the window are
        kept even if one submap alone saw them.
        """
        component = self.graph.component(newest)
        if window is None:
            known = self._joined.get(component)
            window = known.window if known is not None and known.newest == newest else self._window_landmarks([newest])
            window = np.unique(self.graph.landmark_of[window])
        extensible = self._pays(component, window)
        front = (self.graph.records[newest].end, window) if extensible else None
        while True:
            needed = window if extensible else window[:0]
            regions = [] if whole else self.regions.fitting(self.graph, component, needed)
            assembled, result = self.estimator.optimize(self.graph, component, front, regions)
            bent = [r for r in regions if r.carry(self.graph) > self.config.region.bend]
            if not bent:
                break
            self.regions.open(bent, len(self.graph.records))
        report = JoinResult(result.cost, result.iterations, result.converged, assembled.problem.backend, "batch")
        self._joined[component] = _Joined(assembled, report, newest, window, extensible)
        return report

    def _pays(self, component: int, window: IntArray) -> bool:
        """Whether joining through a front of the window's landmarks is less work than batches are by now.

        A submap factors its front some twelve times (three steps, elimination, and once more for the information of the
        first front); a batch is worth about three of its factorisations.
        """
        known = self._joined.get(component)
        if known is None or self.graph.size(component) + 1 < self.config.incremental_from:
            return False
        batch = known.assembled.problem.factor.work - (_clique_work(known.window) if known.extensible else 0.0)
        return _clique_work(window) <= self.config.front_work * batch

    def _front(self, joined: _Joined) -> Front:
        return Front.of(self.graph, joined.assembled, self.graph.records[joined.newest].end, joined.window)

    def _window_landmarks(self, records: list[int]) -> IntArray:
        return np.unique(np.concatenate([self.graph.landmark_of[self.graph.records[i].observations] for i in records]))

    def assembled(self, component: int) -> Assembled:
        """The joining problem of a component with everything in it."""
        joined = self._latest(component)
        if joined.added or joined.assembled.regions:
            self.batch(joined.newest, whole=True)
        return self._joined[component].assembled

    def opened(self, component: int) -> Assembled:
        """What was joined last of a component: with closed regions, and without what was added since."""
        return self._latest(component).assembled

    def _latest(self, component: int) -> _Joined:
        joined = self._joined.get(component)
        if joined is None:  # a map that was just loaded is at its optimum already
            newest = int(self.graph.records_of(component)[-1])
            window = self._window_landmarks([newest])
            assembled = self.estimator.assemble(self.graph, component)
            cost = assembled.problem.cost(assembled.state)
            report = JoinResult(cost, 0, True, assembled.problem.backend, "batch")
            self._joined[component] = joined = _Joined(assembled, report, newest, window)
        return joined

    def cost(self, component: int) -> float:
        """chi2 of a component."""
        return self._latest(component).result.cost

    def totals(self) -> tuple[float, int]:
        """chi2 and redundancy of all components, as far as they have been joined."""
        components = np.unique(self.graph.component_of).tolist()
        return sum(self.cost(c) for c in components), sum(self.redundancy(c) for c in components)

    def variance_factor(self, component: int) -> float:
        """chi2 per degree of freedom: how much larger the errors of a component's submaps are than they claim.

        Never below one: submaps that agree better than they should are not made surer.
        """
        self.assembled(component)
        redundancy = self.redundancy(component)
        return max(1.0, self.cost(component) / redundancy) if redundancy > 0 else 1.0

    def redundancy(self, component: int) -> int:
        """Rows beyond the unknowns of the problem that was last joined in batch."""
        return self._joined[component].assembled.redundancy

    # -- closures ------------------------------------------------------------------------------------------------------

    def relative_pose(self, first: int, second: int) -> Prior | None:
        """What the map knows of T_first_second (starts of two records, the second one the newer); None across
        components. Submaps added since the last batch count with their odometry alone, which is never too sure.
        """
        graph = self.graph
        component = graph.component(first)
        if component != graph.component(second):
            return None
        start = graph.records[first].start
        self._open(component, [start, graph.records[second].start])
        nodes = self._latest(component).assembled.nodes
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

    def _open(self, component: int, nodes: list[int]) -> None:
        """Join with the regions opened that have any of some nodes inside, if the last joining had them closed."""
        joined = self._latest(component)
        hidden = [n for n in nodes if n not in joined.assembled.nodes]
        inside = [r for r in self.regions.closed if np.isin(r.inner, hidden).any()]
        if inside:
            self.regions.open(inside, len(self.graph.records))
            self.batch(joined.newest)

    # -- trials --------------------------------------------------------------------------------------------------------

    def checkpoint(self) -> Checkpoint:
        """Everything a trial may change, to come back to."""
        return Checkpoint(self.graph.snapshot(), dict(self._joined), tuple(self.regions.closed))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Back to a checkpoint taken since the last submap was added."""
        self.graph.restore(checkpoint.graph)
        self._joined = dict(checkpoint.joined)
        self.regions.closed = list(checkpoint.regions)

    def forget(self) -> None:
        """Keep nothing but the graph and its estimate, which must be at the optimum, as after loading a map."""
        self._joined.clear()
        self.regions = Regions(self.estimator.local_maps, self.config.region)

    def forget_stale(self, newest: int) -> None:
        """After links were believed, with the component of ``newest`` joined: the other parts as they are now."""
        own = self.graph.component(newest)
        components = np.unique(self.graph.component_of).tolist()
        for component in self._joined.keys() - {own}:
            records = self.graph.records_of(component) if component in components else []
            if len(records) != self._joined[component].assembled.size:
                del self._joined[component]
                if records:
                    self.batch(records[-1])
