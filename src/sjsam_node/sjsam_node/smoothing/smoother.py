# SPDX-License-Identifier: Apache-2.0
"""The only writer of the estimate: it takes what was added and removed, and brings the map to its optimum.

    result = smoother.update(newest, added, removed)
    marginals = smoother.marginals(component)

What is read is const: it comes from the last update's factor, and is as fresh as that. Every update joins in batch,
warm from the estimate, with the old submaps that nothing new touches condensed to regions
(:mod:`sjsam_node.smoothing.regions`), without those that are redundant and left behind
(:mod:`sjsam_node.smoothing.parking`), and with a selection of the shared landmarks
(:mod:`sjsam_node.graph.selection`): it costs what is near the new submap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.links import Link, Prior
from sjsam_node.graph.map_graph import ALL, MapGraph, Snapshot
from sjsam_node.smoothing.estimator import Assembled, Estimator, EstimatorConfig
from sjsam_node.smoothing.marginals import ComponentMarginals, prior_of_pair, relative_pose, seen_from
from sjsam_node.smoothing.parking import Parked, anchor_of, is_tied
from sjsam_node.smoothing.region import Region
from sjsam_node.smoothing.regions import RegionConfig, Regions
from slam_core.config import Config, group
from slam_core.geometry import FloatArray, compose_covariance
from slam_core.memory import trim


@dataclass(frozen=True)
class SmootherConfig(Config):
    """Parameters of keeping the estimate."""

    settled_work: float = 3e7
    """Entries of the submaps' information matrices up to which a map settles with more than the selected landmarks."""
    settled_ties: int = 24
    """Landmarks by which two submaps are tied together then, at least, where all that they share are too many."""
    estimator: EstimatorConfig = group(EstimatorConfig)
    region: RegionConfig = group(RegionConfig)


@dataclass(frozen=True, eq=False)
class UpdateResult:
    """chi2 of the component and its redundancy, iterations, whether it converged, and the solver.

    doubt: variance factor of what was let go because it contradicted itself.
    """

    cost: float
    redundancy: int
    iterations: int
    converged: bool
    solver: str
    doubt: float = 1.0

    @property
    def strain(self) -> float:
        """chi2 per degree of freedom."""
        return self.cost / self.redundancy if self.redundancy > 0 else 0.0

    @property
    def variance_factor(self) -> float:
        """Factor by which the errors of the submaps are larger than they claim; never below one.

        Submaps that agree better than they should are not made surer.
        """
        return max(self.doubt, self.strain)


@dataclass(eq=False)
class _Solved:
    """A component's last update; ``marginals`` once somebody has asked for them."""

    assembled: Assembled
    result: UpdateResult
    marginals: ComponentMarginals | None = None


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Links, estimate and what was solved at one time."""

    graph: Snapshot
    solved: dict[int, _Solved]
    regions: tuple[Region, ...]
    parked: Parked


@dataclass
class Smoother:
    """Keeps every component of a map graph at its optimum."""

    graph: MapGraph
    config: SmootherConfig = field(default_factory=SmootherConfig)
    estimator: Estimator = field(init=False)
    regions: Regions = field(init=False)
    parked: Parked = field(default_factory=Parked)
    _solved: dict[int, _Solved] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.estimator = Estimator(self.config.estimator)
        self.regions = Regions(self.estimator.local_maps, self.config.region)

    # -- writing -------------------------------------------------------------------------------------------------------

    def update(self, newest: int, added: Sequence[Link] = (), removed: Sequence[Link] = ()) -> UpdateResult:
        """Take in links and let others go, and bring the component of record ``newest`` to its optimum.

        Other components that the change split off are brought to theirs.
        """
        if removed:
            gone = {id(k) for k in removed}
            self.graph.replace_links([k for k in self.graph.links if id(k) not in gone])
        for link in added:
            self.graph.add_link(link)
        result = self._solve(self.graph.component(newest))
        self._solve_changed()
        return result

    def replace(self, removed: Sequence[Link], added: Sequence[Link]) -> None:
        """Let links go and take in others; the next update takes notice, but parts that this splits off do at once."""
        gone = {id(k) for k in removed}
        self.graph.replace_links([*(k for k in self.graph.links if id(k) not in gone), *added])
        self._solve_changed()

    def condense(self, new: int, busy: Sequence[int]) -> None:
        """Join old submaps that nothing touches to regions; ``busy`` records stay as they are."""
        if self.config.estimator.linearises:
            stay = np.concatenate([[new, *busy], self.parked.records, *(r.records for r in self.regions.closed)])
            for record in np.setdiff1d(np.nonzero(self.graph.redundant)[0], stay).tolist():
                self._park(record)
            self.regions.close(self.graph, self.graph.component(new), [new, *busy], self.parked.records)

    def _park(self, record: int) -> None:
        """Leave a redundant record out from here on, if the estimate does not need it."""
        graph, r, solved = self.graph, self.graph.records[record], self._solved.get(self.graph.component(record))
        following = np.nonzero(graph.starts == r.end)[0].tolist()
        if solved is None or not all(is_tied(graph, i) for i in following):
            return
        reference = anchor_of(graph, record, solved.assembled.nodes)
        if reference is None or not np.isin([r.start, r.end], solved.assembled.nodes).all():
            return
        nodes = [reference, r.start, r.end]
        joint, covariances = solved.assembled.covariance(nodes), np.empty((2, 6, 6))
        for k, node in enumerate(nodes[1:]):
            rows = np.append(np.arange(6), 6 * k + 6 + np.arange(6))
            covariances[k] = relative_pose(graph.poses[reference], graph.poses[node], joint[np.ix_(rows, rows)])[1]
        self.parked = self.parked.with_one(graph, record, reference, covariances)

    def settle(self, *, coarse: bool = False) -> None:
        """Bring all to its optimum, with every submap on its own and all shared landmarks, where that is affordable.

        And where they do not contradict each other: then fewer say more. ``coarse``: as near to it as an update does.
        """
        self._choose_ties()
        self._solved.clear()  # the graph has its estimate; problem and factor of before are as large as the new ones
        self.parked = Parked()
        self.regions.clear(len(self.graph.records))
        trim()
        for component in np.unique(self.graph.component_of).tolist():
            self._solve(component, coarse=coarse)

    def resume(self) -> None:
        """Keep nothing but the graph and its estimate, which is at its optimum: after loading as after saving."""
        self._choose_ties()
        self.forget()
        self.parked = Parked()
        self.regions = Regions(self.estimator.local_maps, self.config.region)
        for component in np.unique(self.graph.component_of).tolist():
            assembled = self.estimator.assemble(self.graph, component)
            cost = assembled.problem.cost(assembled.state)
            self._solved[component] = _Solved(assembled, self._result_of(component, assembled, cost, 0, True))

    def forget(self) -> None:
        """Keep nothing of what was solved; the graph has its estimate."""
        self.estimator.forget()
        self._solved.clear()

    def checkpoint(self) -> Checkpoint:
        """Everything that an update changes, to come back to."""
        return Checkpoint(self.graph.snapshot(), dict(self._solved), tuple(self.regions.closed), self.parked)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Back to a checkpoint taken since the last submap was added."""
        self.graph.restore(checkpoint.graph)
        self._solved = dict(checkpoint.solved)
        self.regions.closed = list(checkpoint.regions)
        self.parked = checkpoint.parked

    def _choose_ties(self) -> None:
        """As many landmarks as the work allows; those selected alone where submaps contradicted each other."""
        contradicted = bool((self.graph.doubt > 1.0).any())
        for least in (0,) if contradicted else (ALL, self.config.settled_ties, 0):
            self.graph.tie_by(least)
            if self._work() <= self.config.settled_work:
                break

    def _work(self) -> float:
        """Entries of the information matrices that the selected landmarks make."""
        ties = np.bincount(self.graph.record_of[self.graph.tying()], minlength=len(self.graph.records))
        return float(np.square(6.0 + 3.0 * ties).sum())

    def _solve(self, component: int, *, coarse: bool = True) -> UpdateResult:
        """Optimise a component; regions that this bends are opened."""
        while True:
            parked = self._parked_in(component)
            regions = self.regions.fitting(self.graph, component, self.parked.records)
            assembled, found = self.estimator.optimize(self.graph, component, regions, parked, coarse=coarse)
            bent = [r for r in regions if r.carry(self.graph) > self.config.region.largest_turn(r)]
            if not bent:
                break
            self.regions.open(bent, len(self.graph.records))
        parked.carry(self.graph, assembled.nodes)
        result = self._result_of(component, assembled, found.cost, found.iterations, found.converged)
        self._solved[component] = _Solved(assembled, result)
        return result

    def _result_of(
        self, component: int, assembled: Assembled, cost: float, iterations: int, converged: bool
    ) -> UpdateResult:
        doubt = float(self.graph.doubt[self.graph.records_of(component)].max())
        return UpdateResult(cost, assembled.redundancy, iterations, converged, assembled.problem.backend, doubt)

    def _parked_in(self, component: int) -> Parked:
        """Parked records of a component; those whose reference is in another one by now are taken back."""
        own = self.graph.component_of[self.parked.nodes[:, 0]]
        self.parked = self.parked.at(np.nonzero(own == self.graph.component_of[self.parked.reference])[0])
        return self.parked.at(np.nonzero(self.graph.component_of[self.parked.nodes[:, 0]] == component)[0])

    def _solve_changed(self) -> None:
        """Forget components that are no more, and solve those that have other records than when they were solved."""
        components = np.unique(self.graph.component_of).tolist()
        for gone in self._solved.keys() - set(components):
            del self._solved[gone]
        for component in components:
            solved = self._solved.get(component)
            if solved is None or solved.assembled.size != len(self.graph.records_of(component)):
                self._solve(component)

    # -- reading -------------------------------------------------------------------------------------------------------

    def result(self, component: int) -> UpdateResult:
        """Result of the last update of a component."""
        return self._solved[component].result

    def assembled(self, component: int) -> Assembled:
        """The problem of a component's last update."""
        return self._solved[component].assembled

    def totals(self) -> tuple[float, int]:
        """chi2 and redundancy of all components."""
        results = [s.result for s in self._solved.values()]
        return sum(r.cost for r in results), sum(r.redundancy for r in results)

    def marginals(self, component: int) -> ComponentMarginals:
        """Covariances of a component from the factor of its last update, multiplied by its variance factor."""
        solved = self._solved[component]
        if solved.marginals is None:
            solved.marginals = ComponentMarginals(self.graph, solved.assembled, solved.result.variance_factor)
        return solved.marginals

    def relative_pose(self, first: int, second: int) -> Prior | None:
        """Estimate of T_first_second (starts of two records, the second one the newer).

        None across components. What the last factor does not hold counts with its odometry alone, which is never too
        sure.
        """
        graph, component = self.graph, self.graph.component(first)
        if component != graph.component(second):
            return None
        first_node, T_first, first_covariance = self._anchored(component, first)
        node, T, covariance = self._anchored(component, second)
        if first_node is None or node is None:
            return None
        joint = self.assembled(component).covariance([first_node, node])
        T_known, known = relative_pose(graph.poses[first_node], graph.poses[node], joint)
        T_node, T_covariance = T_known @ T, compose_covariance(T_known, known, T, covariance)
        return prior_of_pair(*seen_from(T_first, first_covariance, T_node, T_covariance))

    def _anchored(self, component: int, record: int) -> tuple[int | None, FloatArray, FloatArray]:
        """The last node before a record's start that the last factor holds, and the way from there."""
        graph, nodes = self.graph, self.assembled(component).nodes
        node, T, covariance = graph.records[record].start, np.eye(4), np.zeros((6, 6))
        while node not in nodes:
            found = self.assembled(component).moving_with(node)
            if found is not None:
                reference, T_node, own = found
                return reference, T_node @ T, compose_covariance(T_node, own, T, covariance)
            before = graph.record_ending_at(node)
            if before is None:
                return None, T, covariance
            submap = graph.records[before].submap
            covariance = compose_covariance(submap.end_pose, submap.covariance[:6, :6], T, covariance)
            T = submap.end_pose @ T
            node = graph.records[before].start
        return node, T, covariance
