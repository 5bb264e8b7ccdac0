# SPDX-License-Identifier: Apache-2.0
"""From the map graph to the joining problem and back: reduce, optimise, judge, recover.

A landmark that ties no submaps together constrains nothing. It is marginalised out of its submap before joining (a
Gaussian's rows are dropped) and recovered afterwards from its correlation with what was joined, both exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from sjsam_node.graph import offload
from sjsam_node.graph.map_graph import BoolArray, MapGraph, Record
from sjsam_node.smoothing import kernels
from sjsam_node.smoothing.joining import JoiningProblem, joint_errors, map_residual
from sjsam_node.smoothing.parking import Parked
from sjsam_node.smoothing.problem import FlatMaps, JoiningState, LocalMap, block_rows, flatten, split
from sjsam_node.smoothing.region import Region
from sjsam_node.smoothing.robust import RobustConfig, RobustJoining, closing_rows, predicted
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray, compose_covariance, make_transform, so3_log
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig
from slam_core.linear_algebra import blas
from slam_core.linear_algebra.block_pattern import IntArray, pointers
from slam_core.linear_algebra.sparse_cholesky import BACKENDS

_UNMOVED = 1e-4
"""Squared change of a submap's residual, in sigmas, below which its own landmarks stay where they were in it."""


@dataclass(frozen=True)
class EstimatorConfig(Config):
    """Parameters of the joining problem and its solver."""

    rows: str = parameter(
        "joint", "noise of a submap: its joint covariance, or per landmark", choices=("joint", "block")
    )
    iterations: int = parameter(30, "Gauss-Newton iterations per closure; 1 is Algorithm 4 as written", minimum=1)
    solver: str = parameter("auto", "sparse solver", choices=BACKENDS)
    relative_tolerance: float = 1e-9
    """Stop when a step promises to lower chi2 by less than this share."""
    live_tolerance: float = 1e-4
    """The same while submaps come in; the map is brought to its optimum when it settles."""
    live_iterations: int = 6
    """Iterations of an update while submaps come in, at most."""
    robust: RobustConfig = group(RobustConfig)

    @property
    def linearises(self) -> bool:
        """True if submaps may be joined to larger ones: at the optimum, and with all their rows."""
        return self.robust.loss == "none" and self.iterations > 1


@dataclass(frozen=True, eq=False)
class ReducedMap:
    """A submap without the landmarks that tie it to no other.

    shared, private: indices of its landmarks. mean (m,) of (end position, end rotation vector, shared landmarks) and
    information (m, m). cross (3p, m): covariance of the private landmarks with what was kept, None where they are not
    recovered.
    """

    shared: IntArray
    private: IntArray
    mean: FloatArray
    information: FloatArray
    cross: FloatArray | None


def reduce_map(record: Record, is_shared: BoolArray, rows: str, *, recover: bool = True) -> ReducedMap:
    """Marginalise the private landmarks of a record out."""
    submap = record.submap
    shared, private = np.nonzero(is_shared)[0], np.nonzero(~is_shared)[0]
    kept = np.concatenate([np.arange(6), (6 + 3 * shared[:, None] + np.arange(3)).ravel()])
    end = submap.end_pose
    mean = np.concatenate([end[:3, 3], so3_log(end[:3, :3]), submap.landmarks[shared].ravel()])
    information = blas.inverse(submap.covariance[np.ix_(kept, kept)])
    if rows == "block":
        information = block_rows(LocalMap(0, np.array([1]), shared, mean, information), 6, 3).information
    if rows == "block" or not recover:
        return ReducedMap(shared, private, mean, information, None)
    dropped = (6 + 3 * private[:, None] + np.arange(3)).ravel()
    return ReducedMap(shared, private, mean, information, submap.covariance[np.ix_(dropped, kept)])


@dataclass(frozen=True, eq=False)
class _Recovered:
    """Private landmarks (p, 3) of a reduced submap in its frame, and the residual that they were recovered from."""

    reduced: ReducedMap
    residual: FloatArray
    weighted: FloatArray
    private: FloatArray


@dataclass(frozen=True, eq=False)
class Assembled:
    """One component as a joining problem: which nodes, landmarks, records and regions of records it is made of.

    maps: the reduced submaps, then the regions. observations: those of the reduced submaps' landmarks, (k,). dropped:
    scalar rows of each map that a robust loss left out.
    """

    records: list[int]
    regions: tuple[Region, ...]
    nodes: IntArray
    landmarks: IntArray
    reduced: list[ReducedMap]
    observations: IntArray
    maps: FlatMaps
    problem: JoiningProblem
    state: JoiningState
    dropped: list[IntArray]
    parked: Parked = field(default_factory=Parked)

    @property
    def size(self) -> int:
        """Number of records, parked ones and those inside the regions included."""
        return len(self.records) + len(self.parked) + sum(len(r.records) for r in self.regions)

    @property
    def redundancy(self) -> int:
        """Rows beyond the unknowns, those inside the regions included."""
        return self.problem.rows - self.problem.layout.pattern.n + sum(r.redundancy for r in self.regions)

    def moving_with(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        """The reference of a node that was not estimated by itself, T_reference_node and its covariance (6, 6)."""
        if (found := self._in_region(node)) is not None:
            return found
        parked = self.parked.node(node)
        anchor = None if parked is None else self._in_region(parked[0])
        if parked is None or anchor is None:
            return parked
        covariance = compose_covariance(anchor[1], anchor[2], parked[1], parked[2])
        return anchor[0], anchor[1] @ parked[1], covariance

    def _in_region(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        nodes, region_of = self._inner
        at = int(np.searchsorted(nodes, node))
        if at == len(nodes) or nodes[at] != node:
            return None
        region: Region = self.regions[region_of[at]]
        return region.node(node)

    @cached_property
    def _inner(self) -> tuple[IntArray, IntArray]:
        """Nodes inside regions, ascending, and the region of each."""
        nodes = np.concatenate([np.empty(0, dtype=np.int64), *(r.inner for r in self.regions)])
        order = np.argsort(nodes)
        return nodes[order], np.repeat(np.arange(len(self.regions)), [len(r.inner) for r in self.regions])[order]

    def nis(self) -> FloatArray:
        """Squared error (k,) of each of the ``observations`` as the rest of its submap predicts it.

        3 degrees of freedom each.
        """
        return joint_errors(kernels.TANGENT, self.maps.first(len(self.records)), self.state)[2]

    def covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Joint covariance (6k, 6k) of nodes that are not inside a region, from the last factor."""
        return self.problem.columns(self.state, np.searchsorted(self.nodes, nodes))


@dataclass
class Estimator:
    """Optimises components of a map graph; keeps the reduced submaps, which change only where links change.

    Of those alone that take part in the last update: what is parked or inside a region is reduced anew where needed.
    """

    config: EstimatorConfig = field(default_factory=EstimatorConfig)
    _cache: dict[int, ReducedMap] = field(default_factory=dict)
    _was_tying: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    _recovered: dict[int, _Recovered] = field(default_factory=dict)

    def assemble(
        self,
        graph: MapGraph,
        component: int,
        regions: Sequence[Region] = (),
        parked: Parked | None = None,
    ) -> Assembled:
        """Pose the joining problem of a component, its frame fixed at the start of its oldest record.

        ``regions`` stand for their records; ``parked`` ones are left out.
        """
        parked = parked or Parked()
        is_inside = np.zeros(len(graph.records), dtype=bool)
        for inside in [parked.records, *(region.records for region in regions)]:
            is_inside[inside] = True
        records = [i for i in graph.records_of(component) if not is_inside[i]]
        reduced = self._reduced(graph, records)
        nodes = np.unique(
            np.concatenate(
                [graph.starts[records], graph.ends[records], *([r.reference, *r.separator] for r in regions)]
            )
        ).astype(np.int64)
        observations = _observations(graph, records, [m.shared for m in reduced])
        seen = graph.variable_of[observations]
        landmarks = np.unique(np.concatenate([seen, *(graph.variable_of[r.landmarks] for r in regions)]))
        maps = flatten([
            *_local_maps(graph, records, reduced, nodes, landmarks),
            *(region.local_map(graph, nodes, landmarks) for region in regions),
        ])  # fmt: skip
        poses = graph.poses[nodes]
        state = JoiningState(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), graph.points[landmarks]
        )
        anchor = np.searchsorted(nodes, [graph.oldest(component).start])
        constant = sum(region.constant for region in regions)
        problem = JoiningProblem(maps, state, anchor, kernels.TANGENT, self.config.solver, None, constant)
        nothing = [np.empty(0, dtype=np.int64)] * len(records)
        return Assembled(
            records, tuple(regions), nodes, landmarks, reduced, observations, maps, problem, state, nothing, parked
        )  # fmt: skip

    def local_maps(self, graph: MapGraph, records: list[int], nodes: IntArray, landmarks: IntArray) -> list[LocalMap]:
        """Reduced records over sorted lists of nodes and landmarks."""
        return _local_maps(graph, records, self._reduced(graph, records), nodes, landmarks)

    def _reduced(self, graph: MapGraph, records: list[int]) -> list[ReducedMap]:
        tying, before = graph.tying(), self._was_tying
        changed = np.nonzero(tying[: len(before)] != before)[0]
        for i in np.unique(graph.record_of[changed]).tolist():
            self._cache.pop(i, None)
        self._was_tying = tying
        for i in records:
            if i not in self._cache:
                record, recover = graph.records[i], not graph.redundant[i]
                self._cache[i] = reduce_map(record, tying[record.observations], self.config.rows, recover=recover)
                offload.forget(record.submap.covariance)  # of the whole of it, two thirds of a map, none is used again
        return [self._cache[i] for i in records]

    def forget(self) -> None:
        """Keep nothing of former updates."""
        self._cache.clear()
        self._recovered.clear()

    def optimize(
        self,
        graph: MapGraph,
        component: int,
        regions: Sequence[Region] = (),
        parked: Parked | None = None,
        *,
        coarse: bool = False,
    ) -> tuple[Assembled, LeastSquaresResult]:
        """Bring a component to its optimum and write it back to the graph, but for what is inside the ``regions``.

        ``coarse``: to where a step promises less than ``live_tolerance``.
        """
        assembled = self.assemble(graph, component, regions, parked)
        held = set(assembled.records)
        for i in [i for i in self._cache if i not in held and graph.component(i) == component]:
            del self._cache[i]
            self._recovered.pop(i, None)
        tolerance = self.config.live_tolerance if coarse else self.config.relative_tolerance
        most = min(self.config.iterations, self.config.live_iterations) if coarse else self.config.iterations
        optimizer = LevenbergMarquardtConfig(most, tolerance)
        state, result = assembled.problem.optimize(assembled.state, optimizer, keep_factor=coarse)
        if self.config.robust.loss != "none":
            state, result, assembled = self._robust(assembled, state, optimizer)
        graph.poses[assembled.nodes] = make_transform(state.rotations, state.translations)
        graph.points[assembled.landmarks] = state.landmarks
        assembled = replace(assembled, state=state)
        self._recover(graph, assembled, 0.0 if not coarse else _UNMOVED)
        return assembled, result

    def _robust(
        self, assembled: Assembled, state: JoiningState, optimizer: LevenbergMarquardtConfig
    ) -> tuple[JoiningState, LeastSquaresResult, Assembled]:
        """Without the rows that the others contradict; the order of the variables stays."""
        problem, maps = assembled.problem, assembled.maps.unflattened()

        def solve(weighted: list[LocalMap], start: JoiningState) -> JoiningState:
            problem.maps = flatten(weighted)
            return problem.optimize(start, optimizer)[0]

        rows = closing_rows(maps, *state.model_dimensions)
        joining = RobustJoining(maps, rows, partial(map_residual, problem.model), solve, self.config.robust)
        found = joining.run(state)
        problem.maps = flatten(found.maps)
        state, result = problem.optimize(found.state, optimizer)
        return state, result, replace(assembled, dropped=found.dropped)

    def _recover(self, graph: MapGraph, assembled: Assembled, unmoved: float) -> None:
        """Landmarks given what was joined; of a submap whose residual hardly changed they stay as they were in it."""
        records, own = assembled.records, assembled.maps.first(len(assembled.records))
        graph.points[assembled.observations] = graph.points[graph.variable_of[assembled.observations]]
        residual, weighted, _ = joint_errors(kernels.TANGENT, own, assembled.state)
        each = split(residual, own.mean_ptr), split(weighted, own.mean_ptr)
        parts = zip(records, assembled.reduced, *each, strict=True)
        for (i, reduced, r, w), dropped in zip(parts, assembled.dropped, strict=True):
            known = self._recovered.get(i)
            if known is None or known.reduced is not reduced or (r - known.residual) @ (w - known.weighted) > unmoved:
                if len(dropped):
                    w = reduced.information @ predicted(reduced.information, r, dropped)
                private = graph.records[i].submap.landmarks[reduced.private]
                if reduced.cross is not None:
                    private = private + (reduced.cross @ w).reshape(-1, 3)
                self._recovered[i] = _Recovered(reduced, r, w, private)
        every = [self._recovered[i].private for i in records]
        T = np.repeat(graph.poses[graph.starts[records]], [len(p) for p in every], axis=0)
        rows = _observations(graph, records, [m.private for m in assembled.reduced])
        graph.points[rows] = (T[:, :3, :3] @ np.concatenate([np.empty((0, 3)), *every])[..., None])[..., 0] + T[
            :, :3, 3
        ]


def _observations(graph: MapGraph, records: list[int], landmarks: list[IntArray]) -> IntArray:
    """Those of some landmarks of each record, one record after the other."""
    own = [graph.records[i].first_observation + index for i, index in zip(records, landmarks, strict=True)]
    return np.concatenate([np.empty(0, dtype=np.int64), *own])


def _local_maps(
    graph: MapGraph, records: list[int], reduced: list[ReducedMap], nodes: IntArray, landmarks: IntArray
) -> list[LocalMap]:
    seen = np.searchsorted(landmarks, graph.variable_of[_observations(graph, records, [m.shared for m in reduced])])
    ids = split(seen, pointers([len(m.shared) for m in reduced]))
    starts = np.searchsorted(nodes, graph.starts[records]).tolist()
    ends = np.searchsorted(nodes, graph.ends[records]).reshape(-1, 1)
    parts = zip(starts, ends, ids, reduced, strict=True)
    return [LocalMap(start, end, own, m.mean, m.information) for start, end, own, m in parts]
