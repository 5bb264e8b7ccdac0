# SPDX-License-Identifier: Apache-2.0
"""Old submaps condensed to larger submaps, so that an update relinearises and refactors only what is new.

A *region* is some submaps that lie together, joined to one Gaussian over what the rest of the map shares with them: its
separator, nodes and landmarks. To the joining problem it is one more local map, in the frame of its reference node
(submaps of submaps: Ni and Dellaert 2010). Regions far from the newest submap are joined to larger ones in turn, so
that an update has few of them however large the map is. A region holds wherever later closures move it as a whole. Once
something inside it is linked to the outside, or its separator turns further than the relinearisation threshold, it is
opened: its parts take part in the joining again, down to single submaps where these are what was touched, until it
has been quiet there for a while.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing import kernels
from sjsam_node.smoothing.joining import JoiningProblem
from sjsam_node.smoothing.problem import JoiningState, LocalMap, flatten
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus, compose_jacobians, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray

_FIRM = 4
"""Landmarks in common that tie two submaps together."""
_WORTH = 0.4
"""A region's normal equations must be smaller than this share of those of its parts together."""
_PARTS = 6
"""Regions that are joined to a larger one, at most."""
_MANY = 10
"""Regions of a component from which on those far away are joined."""

LocalMaps = Callable[[MapGraph, list[int], IntArray, IntArray], list[LocalMap]]
"""Local maps of records, over the nodes and landmarks of two sorted lists."""


@dataclass(frozen=True)
class RegionConfig(Config):
    """Parameters of condensing: which submaps are joined to larger ones until a closure needs them."""

    size: int = parameter(32, "submaps that are joined to a larger one, at most", minimum=2)
    open: int = 64
    """Submaps of a component that take part in each update one by one, about."""
    quiet: int = 10
    """Submaps that came since one was needed, before it may be joined to others."""
    relinearize: float = 0.002
    """Turn of a region's separator since it was linearised beyond which it is opened (rad), up to ``size`` submaps."""

    def largest_turn(self, region: Region) -> float:
        """The same for a region of any size (rad): along a way turns add up like steps of a random walk."""
        return self.relinearize * float(np.sqrt(max(len(region.records) / self.size, 1.0)))


@dataclass(frozen=True, eq=False)
class Region:
    """Records that are joined to one local map, as they were when that was done.

    Attributes
    ----------
    records
        Those joined, ascending.
    reference, separator, inner
        Nodes: the one whose frame it is, others that the rest of the map knows (k,), and those inside (i,).
    poses
        T_reference_node of the separator, (k, 4, 4).
    landmarks
        An observation of each landmark that the rest of the map knows, (n,), and
    points
        where these are in the frame of the reference, (n, 3).
    information, pull, constant
        Over separator and landmarks: the cost is ``r^T information r + 2 pull^T r + constant``.
    separator_observations, group
        Observations of ``landmarks``, and the index of each into them, (r,).
    inner_poses, inner_observations, inner_points
        What is inside, in the frame of the reference: (i, 4, 4), (m,), (m, 3).
    landmark_of, sightings
        What the inner observations were observations of, and how many these had, (m,).
    uses
        How many submaps started or ended at each inner node.
    node_covariances
        Covariance of reference, separator and inner nodes in the frame of the reference, (1 + k + i, 6, 6).
    redundancy
        Rows of the records beyond what is unknown inside and the rows of the local map.
    parts
        Regions that it was joined from, besides single submaps.
    """

    records: IntArray
    reference: int
    separator: IntArray
    inner: IntArray
    poses: FloatArray
    landmarks: IntArray
    points: FloatArray
    information: FloatArray
    pull: FloatArray
    constant: float
    separator_observations: IntArray
    group: IntArray
    inner_poses: FloatArray
    inner_observations: IntArray
    inner_points: FloatArray
    landmark_of: IntArray
    sightings: IntArray
    uses: IntArray
    node_covariances: FloatArray
    redundancy: int
    parts: tuple[Region, ...]

    def holds(self, graph: MapGraph, active: Active, anchor: int) -> bool:
        """True if the rest of the map knows no more of it than when it was joined, and what it knows is still apart.

        ``anchor``: first node of the component.
        """
        nodes, variable_of = np.concatenate([[self.reference], self.separator, self.inner]), graph.variable_of
        sightings, uses = active.sightings, active.uses
        known = variable_of[self.landmarks]
        return bool(
            np.all(graph.component_of[nodes] == graph.component_of[anchor])
            and np.all(self.inner != anchor)
            and np.array_equal(uses[self.inner], self.uses)
            and np.array_equal(variable_of[self.inner_observations], self.landmark_of)
            and np.array_equal(sightings[self.inner_observations], self.sightings)
            and np.array_equal(variable_of[self.separator_observations], known[self.group])
            and len(np.unique(known)) == len(known)
        )

    def shown(self, graph: MapGraph) -> set[int]:
        """Nodes that the rest of the map knows of it, and landmarks, as negative numbers."""
        return {self.reference, *self.separator.tolist(), *(-1 - graph.variable_of[self.landmarks]).tolist()}

    def node(self, node: int) -> tuple[FloatArray, FloatArray]:
        """T_reference_node of a node of the region, and its covariance (6, 6)."""
        nodes = np.concatenate([[self.reference], self.separator, self.inner])
        k = int(np.nonzero(nodes == node)[0][0])
        poses = np.concatenate([np.eye(4)[None], self.poses, self.inner_poses])
        return poses[k], self.node_covariances[k]

    def local_map(self, graph: MapGraph, nodes: IntArray, landmarks: IntArray) -> LocalMap:
        """As the joining problem takes it, over sorted lists of nodes and landmarks."""
        return LocalMap(
            int(np.searchsorted(nodes, self.reference)), np.searchsorted(nodes, self.separator),
            np.searchsorted(landmarks, graph.variable_of[self.landmarks]), self._mean, self.information, self.pull,
        )  # fmt: skip

    @cached_property
    def _mean(self) -> FloatArray:
        return np.concatenate([boxminus(self.poses, np.eye(4)).ravel(), self.points.ravel()])

    def carry(self, graph: MapGraph) -> float:
        """Move what is inside with the reference, after that and the separator were estimated.

        How far the separator turned (rad, or m per m).

        Inside nothing is estimated until the region is opened, or the whole map is asked for.
        """
        T = graph.poses[self.reference]
        graph.poses[self.inner] = T @ self.inner_poses
        graph.points[self.inner_observations] = transform_points(T, self.inner_points)
        T_reference = invert_transform(T)
        shifted = transform_points(T_reference, graph.points[graph.variable_of[self.landmarks]]) - self.points
        moved = T_reference @ graph.poses[self.separator]
        turned = moved[:, :3, :3] @ np.swapaxes(self.poses[:, :3, :3], 1, 2) - np.eye(3)
        places = np.concatenate([np.zeros((1, 3)), self.points, self.poses[:, :3, 3]])
        extent = max(float(np.linalg.norm(np.ptp(places, axis=0))), 1.0)
        shifted = np.concatenate([moved[:, :3, 3] - self.poses[:, :3, 3], shifted])
        sheared = np.linalg.norm(shifted, axis=1).max(initial=0.0) / extent
        # The Frobenius norm of R - I is that of a rotation by an angle a: sqrt(8) sin(a / 2).
        half = np.minimum(np.linalg.norm(turned, axis=(1, 2)).max(initial=0.0) / np.sqrt(8.0), 1.0)
        return max(2.0 * float(np.arcsin(half)), float(sheared))


@dataclass(frozen=True, eq=False)
class Active:
    """Knowledge of the submaps that take part in the estimate, without those ``parked`` (records).

    sightings (observations,) of every observation's landmark; uses (nodes,): how many submaps start or end at each
    node, one more at the end of a way, that may come.
    """

    sightings: IntArray
    uses: IntArray

    @classmethod
    def of(cls, graph: MapGraph, parked: IntArray) -> Active:
        """As the graph is now."""
        takes_part = np.ones(len(graph.records), dtype=bool)
        takes_part[parked] = False
        seen = np.bincount(graph.variable_of[takes_part[graph.record_of]], minlength=len(graph.points))
        ends = np.concatenate([graph.starts[takes_part], graph.ends[takes_part]])
        open_end = np.ones(len(graph.poses), dtype=bool)
        open_end[graph.starts] = False
        uses = np.bincount(ends, minlength=len(graph.poses)) + 2 * open_end
        return cls(np.asarray(seen[graph.variable_of]), np.asarray(uses))


@dataclass
class Regions:
    """The regions of a map, and when each submap was needed last."""

    local_maps: LocalMaps
    config: RegionConfig = field(default_factory=RegionConfig)
    closed: list[Region] = field(default_factory=list)
    _needed: dict[int, int] = field(default_factory=dict)

    def fitting(self, graph: MapGraph, component: int, parked: IntArray) -> list[Region]:
        """Regions of a component; those that do not hold any more are opened, down to the parts that hold."""
        active, anchor = Active.of(graph, parked), graph.oldest(component).start
        while True:
            own = [r for r in self.closed if graph.component_of[r.reference] == component]
            kept = [r for r in own if r.holds(graph, active, anchor)]
            if len(kept) == len(own):
                return kept
            self.open([r for r in own if r not in kept], len(graph.records))

    def open(self, regions: Sequence[Region], now: int) -> None:
        """Let the parts of some regions take part again."""
        parts = [part for region in regions for part in region.parts]
        self.closed = [*(r for r in self.closed if r not in regions), *parts]
        for region in regions:
            inside = [i for part in region.parts for i in part.records.tolist()]
            self._note(np.setdiff1d(region.records, inside), now)

    def clear(self, now: int) -> None:
        """Let all submaps take part again one by one."""
        while self.closed:
            self.open(self.closed, now)

    def _note(self, records: IntArray, now: int) -> None:
        self._needed.update(dict.fromkeys(records.tolist(), now))

    def close(self, graph: MapGraph, component: int, busy: Sequence[int], parked: IntArray) -> None:
        """Join the submaps that have been quiet for longest to one region, if more than enough are open.

        ``busy`` ones stay. Of many regions those far from the newest submap are joined to one, too.
        """
        active, now = Active.of(graph, parked), len(graph.records)
        is_open = graph.component_of[graph.starts] == component
        is_open[parked] = False
        for region in self.closed:
            is_open[region.records] = False
        if np.count_nonzero(is_open) > self.config.open:
            is_open[list(busy)] = False
            self._close_records(
                graph, component, [i for i in np.nonzero(is_open)[0].tolist() if self._quiet(i, now)], active
            )
        anchor = graph.oldest(component).start
        own = [r for r in self.closed if graph.component_of[r.reference] == component]
        if len(own) > _MANY:
            self._close_regions(graph, component, [r for r in own if r.holds(graph, active, anchor)], active)

    def _quiet(self, record: int, now: int) -> bool:
        return now - self._needed.get(record, record) > self.config.quiet

    def _close_records(self, graph: MapGraph, component: int, quiet: list[int], active: Active) -> None:
        if not quiet:
            return
        first = min(quiet, key=lambda i: (self._needed.get(i, i), i))
        chosen = self._gathered(graph, np.array(quiet), first)
        region = join(graph, chosen, component, self.local_maps, active)
        if region is None:
            self._note(chosen, len(graph.records))
        else:
            self.closed.append(region)

    def _close_regions(self, graph: MapGraph, component: int, regions: list[Region], active: Active) -> None:
        now, here = len(graph.records), graph.poses[graph.starts[-1], :3, 3]
        left = [r for r in regions if self._quiet(int(r.records[0]), now)]
        if not left:
            return
        parts = [max(left, key=lambda r: float(np.linalg.norm(graph.poses[r.reference, :3, 3] - here)))]
        known = parts[0].shown(graph)
        while len(parts) < _PARTS:
            left = [r for r in left if r not in parts]
            nearest = max(left, key=lambda r: len(known & r.shown(graph)), default=None)
            if nearest is None or not known & nearest.shown(graph):
                break
            parts.append(nearest)
            known |= nearest.shown(graph)
        none = np.empty(0, dtype=np.int64)
        region = join(graph, none, component, self.local_maps, active, parts) if len(parts) > 1 else None
        if region is None:
            self._note(parts[0].records[:1], now)
        else:
            self.closed = [*(r for r in self.closed if r not in parts), region]

    def _gathered(self, graph: MapGraph, candidates: IntArray, first: int) -> IntArray:
        """Of the candidates nearest to one, those that hang together with it."""
        middles = graph.middles(candidates)
        distance = np.linalg.norm(middles - graph.middles(np.array([first])), axis=1)
        nearest = np.sort(candidates[np.argsort(distance, kind="stable")[: self.config.size]])
        label = _tied(graph, nearest)
        return np.asarray(nearest[label == label[np.searchsorted(nearest, first)]])


def _tied(graph: MapGraph, records: IntArray) -> IntArray:
    """Label for each of some records: equal for those that hang together by nodes or enough landmarks."""
    observations = np.concatenate([graph.records[i].observations for i in records])
    rows, seen = np.searchsorted(records, graph.record_of[observations]), graph.variable_of[observations]
    B = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, seen)), (len(records), len(graph.points)))
    ends = np.stack([graph.starts[records], graph.ends[records]], axis=1)
    E = scipy.sparse.csr_matrix(
        (np.full(ends.size, 10.0 * _FIRM), (np.repeat(np.arange(len(records)), 2), ends.ravel())),
        (len(records), len(graph.poses)),
    )
    common = (B @ B.T + E @ E.T).tocsr()
    common.data[common.data < _FIRM] = 0.0
    common.eliminate_zeros()
    return np.asarray(scipy.sparse.csgraph.connected_components(common, directed=False)[1])


def join(
    graph: MapGraph,
    records: IntArray,
    component: int,
    local_maps: LocalMaps,
    active: Active,
    parts: Sequence[Region] = (),
) -> Region | None:
    """Join records and regions to one region at the graph's estimate.

    None where that does not pay, or is not determined.
    """
    every = np.sort(np.concatenate([records, *(p.records for p in parts)]))
    ends, used = np.unique(np.concatenate([graph.starts[every], graph.ends[every]]), return_counts=True)
    nodes, shared = _outside(graph, records, parts)
    is_separator = (used < active.uses[ends]) | (ends == graph.oldest(component).start)
    if not is_separator.any():  # landmarks alone tie it to the rest
        is_separator[np.searchsorted(ends, nodes[0])] = True
    reference, separator, inner = int(ends[is_separator][0]), ends[is_separator][1:], ends[~is_separator]
    observations = np.concatenate([graph.records[i].observations for i in every])
    seen = graph.variable_of[observations]
    landmarks, first, times = np.unique(seen, return_index=True, return_counts=True)
    known = times < active.sightings[observations[first]]
    T_reference = invert_transform(graph.poses[reference])
    poses, points = T_reference @ graph.poses, transform_points(T_reference, graph.points)
    state = JoiningState(
        np.ascontiguousarray(poses[nodes, :3, :3]), np.ascontiguousarray(poses[nodes, :3, 3]), points[shared]
    )
    maps = [*local_maps(graph, records.tolist(), nodes, shared), *(p.local_map(graph, nodes, shared) for p in parts)]
    at_separator, kept = np.searchsorted(nodes, separator), np.searchsorted(shared, landmarks[known])
    rows = 6 * len(separator) + 3 * len(kept)
    if rows**2 > _WORTH * sum(len(m.mean) ** 2 for m in maps):
        return None
    fixed, last = np.searchsorted(nodes, [reference]), np.concatenate([at_separator, len(nodes) + kept])
    constant = sum(p.constant for p in parts)
    problem = JoiningProblem(flatten(maps), state, fixed, kernels.TANGENT, last=last, constant=constant)
    scalars = problem.scalars(at_separator, kept)
    try:
        newton, least = problem.newton_step(state)
        step, information = newton[scalars], problem.marginal_information(state, scalars)
        marginals = problem.marginals(state)
    except ValueError:
        return None
    covariances = np.zeros((len(graph.poses), 6, 6))
    covariances[nodes] = marginals.pose_blocks(np.arange(len(nodes)))
    for p in parts:
        J_reference, J_node = compose_jacobians(np.broadcast_to(poses[p.reference], p.inner_poses.shape), p.inner_poses)
        own = p.node_covariances[1 + len(p.separator) :]
        covariances[p.inner] = (
            J_reference @ covariances[p.reference] @ np.swapaxes(J_reference, 1, 2)
            + J_node @ own @ np.swapaxes(J_node, 1, 2)
        )  # fmt: skip
    group = np.where(known, np.cumsum(known) - 1, -1)[np.searchsorted(landmarks, seen)]
    is_known, inside = group >= 0, observations[group < 0]
    redundancy = problem.rows - problem.layout.pattern.n + sum(p.redundancy for p in parts)
    return Region(
        every, reference, separator, inner, poses[separator], observations[first[known]], points[landmarks[known]],
        information, -information @ step, float(least + step @ information @ step), observations[is_known],
        group[is_known], poses[inner], inside, points[inside], graph.variable_of[inside],
        active.sightings[inside], active.uses[inner], covariances[np.concatenate([[reference], separator, inner])],
        redundancy, tuple(parts),
    )  # fmt: skip


def _outside(graph: MapGraph, records: IntArray, parts: Sequence[Region]) -> tuple[IntArray, IntArray]:
    """Nodes and landmarks that records and regions are over, ascending."""
    nodes = [graph.starts[records], graph.ends[records], *(np.append(p.separator, p.reference) for p in parts)]
    observations = np.concatenate([np.empty(0, dtype=np.int64), *(graph.records[i].observations for i in records)])
    tying = observations[graph.tying()[observations]]
    seen = graph.variable_of[np.concatenate([tying, *(p.landmarks for p in parts)])]
    return np.unique(np.concatenate(nodes)), np.unique(seen)
