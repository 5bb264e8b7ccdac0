"""Keeps every component of a map graph at its optimum as submaps, links and doubts come in.

A small component is joined in batch each time. A large one stays factored (:mod:`sjsam_node.incremental`): a submap, a
link, or one taken back costs what it affects, and ends at the same optimum. A batch is left for a start so bad that
steps have to be damped, for components that merge or fall apart, and for what is asked of the map as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.association import Prior
from sjsam_node.closures import prior_of_pair, relative_pose
from sjsam_node.estimator import Assembled, Estimator, EstimatorConfig, ReducedMap
from sjsam_node.incremental import JoinedComponent
from sjsam_node.map_graph import MapGraph, Snapshot
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray


@dataclass(frozen=True)
class JoinerConfig(Config):
    """When the map is joined how, and what it takes back."""

    incremental_from: int = parameter(
        40, "submaps of a component from which on they are joined incrementally; below, batch costs no more", minimum=2
    )
    relinearize_turn: float = parameter(
        0.02, "turn of a submap, since it was linearised, after which it is linearised anew", unit="rad", minimum=0.0
    )
    estimator: EstimatorConfig = group(EstimatorConfig)


@dataclass(frozen=True, eq=False)
class JoinResult:
    """chi2 of the component, iterations, whether it converged, solver; ``batch`` or ``incremental``."""

    cost: float
    iterations: int
    converged: bool
    solver: str
    update: str


@dataclass(frozen=True, eq=False)
class _Joined:
    """A component at its optimum: as it stays factored, or as the last batch posed it, or both."""

    result: JoinResult
    live: JoinedComponent | None
    assembled: Assembled | None


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Beliefs, estimate and what was joined at one time."""

    graph: Snapshot
    joined: dict[int, _Joined]


@dataclass
class Joiner:
    """The estimate of a graph."""

    graph: MapGraph
    config: JoinerConfig = field(default_factory=JoinerConfig)
    estimator: Estimator = field(init=False)
    _joined: dict[int, _Joined] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.estimator = Estimator(self.config.estimator)

    def join(self, newest: int) -> JoinResult:
        """Bring the component of record ``newest``, from whose end it goes on, to its optimum."""
        component = self.graph.component(newest)
        return self._updated(component, newest) or self._batch(component)

    def _updated(self, component: int, newest: int) -> JoinResult | None:
        """Join what changed; None where only a batch will do."""
        estimator = self.estimator.config
        if self.graph.size(component) < self.config.incremental_from or not estimator.can_grow:
            return None
        known = self._joined.get(component)
        live = known.live if known is not None else None
        if live is None:
            anchor = self.graph.oldest(component).start
            live = JoinedComponent(self.estimator, anchor, self.config.relinearize_turn)
        found = live.update(self.graph, component, newest)
        if found is None:
            return None
        result = JoinResult(found.cost, found.iterations, found.converged, "multifrontal", "incremental")
        self._joined[component] = _Joined(result, live, None)
        return result

    def _batch(self, component: int) -> JoinResult:
        assembled, found = self.estimator.optimize(self.graph, component)
        result = JoinResult(found.cost, found.iterations, found.converged, assembled.problem.backend, "batch")
        self._joined[component] = _Joined(result, None, assembled)
        return result

    def assembled(self, component: int) -> Assembled:
        """The joining problem of a component with everything in it."""
        known = self._joined.get(component)
        if known is None or known.assembled is None:
            if known is not None and known.live is not None:
                known.live.settle(self.graph)
            assembled = self.estimator.assemble(self.graph, component)
            if known is None:  # a map that was just loaded is at its optimum already
                cost = assembled.problem.cost(assembled.state)
                known = _Joined(JoinResult(cost, 0, True, assembled.problem.backend, "batch"), None, assembled)
            self._joined[component] = known = replace(known, assembled=assembled)
        assert known.assembled is not None
        return known.assembled

    def reduced(self, component: int) -> dict[int, ReducedMap]:
        """Submaps of a component as they are joined."""
        known = self._joined.get(component)
        if known is not None and known.live is not None:
            return known.live.reduced
        assembled = self.assembled(component)
        return dict(zip(assembled.records, assembled.reduced, strict=True))

    def cost(self, component: int) -> float:
        """chi2 of a component."""
        if component not in self._joined:
            self.assembled(component)
        return self._joined[component].result.cost

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
        """Rows beyond the unknowns of a component."""
        known = self._joined.get(component)
        if known is not None and known.live is not None:
            return known.live.redundancy
        problem = self.assembled(component).problem
        return problem.rows - problem.layout.pattern.n

    def covariance(self, component: int, nodes: list[int]) -> FloatArray:
        """Joint covariance (6k, 6k) of nodes of a component."""
        known = self._joined.get(component)
        if known is not None and known.live is not None:
            return known.live.covariance(nodes)
        return self.assembled(component).covariance(nodes)

    # -- closures ------------------------------------------------------------------------------------------------------

    def relative_pose(self, first: int, second: int) -> Prior | None:
        """What the map knows of T_first_second (starts of two records); None across components."""
        graph = self.graph
        component = graph.component(first)
        if component != graph.component(second):
            return None
        nodes = [graph.records[first].start, graph.records[second].start]
        joint = self.covariance(component, nodes)
        return prior_of_pair(*relative_pose(graph.poses[nodes[0]], graph.poses[nodes[1]], joint))

    # -- trials --------------------------------------------------------------------------------------------------------

    def checkpoint(self) -> Checkpoint:
        """Everything a trial may change, to come back to."""
        joined = {c: replace(k, live=None if k.live is None else k.live.copy()) for c, k in self._joined.items()}
        return Checkpoint(self.graph.snapshot(), joined)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Back to a checkpoint taken since the last submap was added."""
        self.graph.restore(checkpoint.graph)
        self._joined = dict(checkpoint.joined)

    def forget(self) -> None:
        """Keep nothing but the graph and its estimate, which must be at the optimum, as after loading a map."""
        self._joined.clear()

    def forget_stale(self, newest: int) -> None:
        """After links were believed, with the component of ``newest`` joined: the other parts as they are now."""
        own = self.graph.component(newest)
        components = np.unique(self.graph.component_of).tolist()
        for component in self._joined.keys() - {own}:
            records = self.graph.records_of(component) if component in components else []
            if set(records) != self.reduced(component).keys():
                del self._joined[component]
                if records:
                    self.join(records[-1])
