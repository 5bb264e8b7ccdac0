# SPDX-License-Identifier: Apache-2.0
"""From the map graph to the joining problem and back: reduce, optimise, judge, recover.

A landmark that ties no submaps together constrains nothing. It is marginalised out of its submap before joining (a
Gaussian's rows are dropped) and recovered afterwards from its correlation with what was joined, both exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sjsam_node.graph.map_graph import BoolArray, MapGraph, Record
from sjsam_node.smoothing import kernels
from sjsam_node.smoothing.joining import JoiningProblem, map_residual
from sjsam_node.smoothing.parking import Parked
from sjsam_node.smoothing.problem import JoiningState, LocalMap, block_rows, flatten
from sjsam_node.smoothing.regions import Region
from sjsam_node.smoothing.robust import RobustConfig, RobustJoining, closing_rows, predicted
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray, make_transform, so3_log
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig
from slam_core.linear_algebra import blas
from slam_core.linear_algebra.sparse_cholesky import BACKENDS, IntArray


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
class Assembled:
    """One component as a joining problem: which nodes, landmarks, records and regions of records it is made of.

    maps: the reduced submaps as they are joined, then the regions. dropped: scalar rows of each that a robust loss left
    out.
    """

    records: list[int]
    regions: tuple[Region, ...]
    nodes: IntArray
    landmarks: IntArray
    reduced: list[ReducedMap]
    maps: list[LocalMap]
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
        for region in self.regions:
            if node in region.inner:
                return region.reference, *region.node(node)
        return self.parked.node(node)

    def covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Joint covariance (6k, 6k) of nodes that are not inside a region, from the last factor."""
        return self.problem.columns(self.state, np.searchsorted(self.nodes, nodes))


@dataclass
class Estimator:
    """Optimises components of a map graph; keeps the reduced submaps, which change only where links change.

    Of those alone that take part in the last update: what is parked or inside a region is reduced anew where needed.
    """

    config: EstimatorConfig = field(default_factory=EstimatorConfig)
    _cache: dict[int, tuple[bytes, ReducedMap]] = field(default_factory=dict)

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
        inside = {i for region in regions for i in region.records.tolist()} | set(parked.records.tolist())
        records = [i for i in graph.records_of(component) if i not in inside]
        is_shared = graph.tying()
        reduced = [self._reduced(graph, i, is_shared) for i in records]
        own = [graph.records[i] for i in records]
        nodes = np.unique(
            [n for r in own for n in (r.start, r.end)] + [n for r in regions for n in (r.reference, *r.separator)]
        )
        seen = [graph.variable_of[r.observations[m.shared]] for r, m in zip(own, reduced, strict=True)]
        landmarks = np.unique(np.concatenate([*seen, *(graph.variable_of[r.landmarks] for r in regions)]))
        maps = [
            *_local_maps(graph, records, reduced, nodes, landmarks),
            *(region.local_map(graph, nodes, landmarks) for region in regions),
        ]
        poses = graph.poses[nodes]
        state = JoiningState(
            np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), graph.points[landmarks]
        )
        anchor = np.searchsorted(nodes, [graph.oldest(component).start])
        constant = sum(region.constant for region in regions)
        problem = JoiningProblem(flatten(maps), state, anchor, kernels.TANGENT, self.config.solver, None, constant)
        nothing = [np.empty(0, dtype=np.int64)] * len(records)
        return Assembled(
            records, tuple(regions), nodes, landmarks, reduced, maps, problem, state, nothing, parked
        )  # fmt: skip

    def local_maps(self, graph: MapGraph, records: list[int], nodes: IntArray, landmarks: IntArray) -> list[LocalMap]:
        """Reduced records over sorted lists of nodes and landmarks."""
        is_shared = graph.tying()
        return _local_maps(graph, records, [self._reduced(graph, i, is_shared) for i in records], nodes, landmarks)

    def _reduced(self, graph: MapGraph, record: int, is_shared: BoolArray) -> ReducedMap:
        mask = is_shared[graph.records[record].observations]
        known = self._cache.get(record)
        if known is None or known[0] != mask.tobytes():
            recover = not graph.redundant[record]
            known = (mask.tobytes(), reduce_map(graph.records[record], mask, self.config.rows, recover=recover))
            self._cache[record] = known
        return known[1]

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
        for i in set(graph.records_of(component)).difference(assembled.records):
            self._cache.pop(i, None)
        tolerance = self.config.live_tolerance if coarse else self.config.relative_tolerance
        most = min(self.config.iterations, self.config.live_iterations) if coarse else self.config.iterations
        optimizer = LevenbergMarquardtConfig(most, tolerance)
        state, result = assembled.problem.optimize(assembled.state, optimizer, keep_factor=coarse)
        if self.config.robust.loss != "none":
            state, result, assembled = self._robust(assembled, state, optimizer)
        graph.poses[assembled.nodes] = make_transform(state.rotations, state.translations)
        graph.points[assembled.landmarks] = state.landmarks
        for i, reduced, dropped in zip(assembled.records, assembled.reduced, assembled.dropped, strict=True):
            self._recover(graph, graph.records[i], reduced, dropped)
        assembled.parked.carry(graph, assembled.nodes)
        return replace(assembled, state=state), result

    def _robust(
        self, assembled: Assembled, state: JoiningState, optimizer: LevenbergMarquardtConfig
    ) -> tuple[JoiningState, LeastSquaresResult, Assembled]:
        """Without the rows that the others contradict; the order of the variables stays."""
        problem, maps = assembled.problem, assembled.maps

        def solve(weighted: list[LocalMap], start: JoiningState) -> JoiningState:
            problem.maps = flatten(weighted)
            return problem.optimize(start, optimizer)[0]

        rows = closing_rows(maps, *state.model_dimensions)
        joining = RobustJoining(maps, rows, partial(map_residual, problem.model), solve, self.config.robust)
        found = joining.run(state)
        problem.maps = flatten(found.maps)
        state, result = problem.optimize(found.state, optimizer)
        return state, result, replace(assembled, maps=found.maps, dropped=found.dropped)

    @staticmethod
    def _recover(graph: MapGraph, record: Record, reduced: ReducedMap, dropped: IntArray) -> None:
        """Landmarks of a record given what was joined."""
        T, rows = graph.poses[record.start], record.observations
        graph.points[rows[reduced.shared]] = graph.points[graph.variable_of[rows[reduced.shared]]]
        private = record.submap.landmarks[reduced.private]
        if reduced.cross is not None:
            residual = predicted(reduced.information, local_residual(graph, record, reduced), dropped)
            private = private + (reduced.cross @ (reduced.information @ residual)).reshape(-1, 3)
        graph.points[rows[reduced.private]] = private @ T[:3, :3].T + T[:3, 3]


def _local_maps(
    graph: MapGraph, records: list[int], reduced: list[ReducedMap], nodes: IntArray, landmarks: IntArray
) -> list[LocalMap]:
    out = []
    for i, m in zip(records, reduced, strict=True):
        r = graph.records[i]
        ids = np.searchsorted(landmarks, graph.variable_of[r.observations[m.shared]])
        start, end = np.searchsorted(nodes, [r.start, r.end])
        out.append(LocalMap(int(start), np.array([end]), ids, m.mean, m.information))
    return out


def local_residual(graph: MapGraph, record: Record, reduced: ReducedMap) -> FloatArray:
    """Residual ``h [-] z`` (m,) of a record at the graph's estimate."""
    poses = graph.poses[[record.start, record.end]]
    points = graph.points[graph.variable_of[record.observations[reduced.shared]]]
    state = JoiningState(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), points)
    local = LocalMap(0, np.array([1]), np.arange(len(points)), reduced.mean, reduced.information)
    return map_residual(kernels.TANGENT, local, state)


def observation_nis(residual: FloatArray, information: FloatArray) -> FloatArray:
    """Squared error of each landmark of a local map as all its other rows predict it; 3 degrees of freedom each."""
    n = (len(residual) - 6) // 3
    weighted = (information @ residual)[6:].reshape(n, 3)
    blocks = information[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
    return np.asarray(np.einsum("ni,ni->n", weighted, np.linalg.solve(blocks, weighted[..., None])[..., 0]))
