# SPDX-License-Identifier: Apache-2.0
"""Old submaps condensed to larger submaps, so that an update relinearises and refactors only what is new.

A *region* is some submaps that lie together, joined to one Gaussian over what the rest of the map shares with them: its
separator, nodes and landmarks. To the joining problem it is one more local map, in the frame of its reference node
(submaps of submaps: Ni and Dellaert 2010). It holds wherever later closures move it as a whole. Once something inside
it is linked to the outside, or its separator turns further than the relinearisation threshold, it is opened: its
submaps take part in the joining again one by one, until it has been quiet there for a while.
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
from slam_core.geometry import FloatArray, boxminus, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray

_FIRM = 4
"""Landmarks in common that tie two submaps together."""
_WORTH = 0.4
"""A region's normal equations must be smaller than this share of those of its submaps together."""

LocalMaps = Callable[[MapGraph, list[int], IntArray, IntArray], list[LocalMap]]
"""Local maps of records, over the nodes and landmarks of two sorted lists."""


@dataclass(frozen=True)
class RegionConfig(Config):
    """Parameters of condensing: which submaps are joined to larger ones until a closure needs them."""

    size: int = parameter(96, "submaps that are joined to a larger one, at most", minimum=2)
    open: int = 64
    """Submaps of a component that take part in each update one by one, about."""
    quiet: int = 10
    """Submaps that came since one was needed, before it may be joined to others."""
    relinearize: float = 0.002
    """Turn of a region's separator since it was linearised beyond which it is opened (rad)."""


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

    def holds(self, graph: MapGraph, sightings: IntArray, uses: IntArray, anchor: int) -> bool:
        """True if the rest of the map knows no more of it than when it was joined, and what it knows is still apart.

        ``sightings`` of every observation's landmark, ``uses`` of every node, the ``anchor`` of the component.
        """
        nodes, variable_of = np.concatenate([[self.reference], self.separator, self.inner]), graph.variable_of
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
        extent = max(float(np.linalg.norm(np.ptp(self.points, axis=0))) if len(self.points) else 0.0, 1.0)
        shifted = np.concatenate([moved[:, :3, 3] - self.poses[:, :3, 3], shifted])
        sheared = np.linalg.norm(shifted, axis=1).max(initial=0.0) / extent
        # The Frobenius norm of R - I is that of a rotation by an angle a: sqrt(8) sin(a / 2).
        half = np.minimum(np.linalg.norm(turned, axis=(1, 2)).max(initial=0.0) / np.sqrt(8.0), 1.0)
        return max(2.0 * float(np.arcsin(half)), float(sheared))


@dataclass
class Regions:
    """The regions of a map, and when each submap outside of them was needed last."""

    local_maps: LocalMaps
    config: RegionConfig = field(default_factory=RegionConfig)
    closed: list[Region] = field(default_factory=list)
    _needed: dict[int, int] = field(default_factory=dict)

    def fitting(self, graph: MapGraph, component: int) -> list[Region]:
        """Regions of a component; those that do not hold any more are opened."""
        sightings, uses, anchor = _sightings(graph), _uses(graph), graph.oldest(component).start
        own = [r for r in self.closed if graph.component_of[r.reference] == component]
        kept = [r for r in own if r.holds(graph, sightings, uses, anchor)]
        self.open([r for r in own if not any(r is k for k in kept)], len(graph.records))
        return kept

    def open(self, regions: Sequence[Region], now: int) -> None:
        """Let the submaps of some regions take part again one by one."""
        for region in regions:
            self._needed.update(dict.fromkeys(region.records.tolist(), now))
        self.closed = [r for r in self.closed if not any(r is other for other in regions)]

    def close(self, graph: MapGraph, component: int, busy: set[int]) -> None:
        """Join the submaps that have been quiet for longest to one region, if more than enough are open.

        ``busy`` ones stay. Small regions nearby become part of it.
        """
        now = len(graph.records)
        inside = {i for r in self.closed for i in r.records.tolist()}
        opened = [i for i in graph.records_of(component) if i not in inside]
        if len(opened) <= self.config.open:
            return
        quiet = [i for i in opened if i not in busy and now - self._needed.get(i, i) > self.config.quiet]
        if not quiet:
            return
        first = min(quiet, key=lambda i: (self._needed.get(i, i), i))
        small = [
            r
            for r in self.closed
            if len(r.records) < self.config.size // 2 and graph.component_of[r.reference] == component
        ]
        chosen = self._gathered(graph, np.concatenate([quiet, *(r.records for r in small)]), first)
        region = join(graph, chosen, component, self.local_maps)
        if region is None:
            self._needed[first] = now
        else:
            taken = [r for r in small if np.isin(r.records, chosen).any()]
            self.closed = [*(r for r in self.closed if not any(r is t for t in taken)), region]

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


def _sightings(graph: MapGraph) -> IntArray:
    """Number of observations of each observation's landmark."""
    return np.asarray(np.bincount(graph.variable_of, minlength=len(graph.points))[graph.variable_of])


def _uses(graph: MapGraph) -> IntArray:
    """Number of submaps that start or end at each node; one more at the end of a way, that may come."""
    uses = np.bincount(np.concatenate([graph.starts, graph.ends]), minlength=len(graph.poses))
    open_end = np.ones(len(uses), dtype=bool)
    open_end[graph.starts] = False
    return np.asarray(uses + 2 * open_end)


def join(graph: MapGraph, records: IntArray, component: int, local_maps: LocalMaps) -> Region | None:
    """Join records to one region at the graph's estimate; None where that does not pay, or is not determined."""
    sightings, uses = _sightings(graph), _uses(graph)
    own = [graph.records[i] for i in records]
    nodes, used = np.unique([(r.start, r.end) for r in own], return_counts=True)
    is_separator = (used < uses[nodes]) | (nodes == graph.oldest(component).start)
    reference, separator, inner = int(nodes[is_separator][0]), nodes[is_separator][1:], nodes[~is_separator]
    observations = np.concatenate([r.observations for r in own])
    seen = graph.variable_of[observations]
    landmarks, first, times = np.unique(seen, return_index=True, return_counts=True)
    known = times < sightings[observations[first]]
    shared = landmarks[sightings[observations[first]] > 1]
    T_reference = invert_transform(graph.poses[reference])
    poses, points = T_reference @ graph.poses[nodes], transform_points(T_reference, graph.points)
    state = JoiningState(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), points[shared])
    maps = local_maps(graph, records.tolist(), nodes, shared)
    at_separator, kept = np.searchsorted(nodes, separator), np.searchsorted(shared, landmarks[known])
    rows = 6 * len(separator) + 3 * len(kept)
    if rows**2 > _WORTH * sum(len(m.mean) ** 2 for m in maps):
        return None
    fixed, last = np.searchsorted(nodes, [reference]), np.concatenate([at_separator, len(nodes) + kept])
    problem = JoiningProblem(flatten(maps), state, fixed, kernels.TANGENT, last=last)
    scalars = problem.scalars(at_separator, kept)
    try:
        newton, least = problem.newton_step(state)
        step, information = newton[scalars], problem.marginal_information(state, scalars)
        marginals = problem.marginals(state)
    except ValueError:
        return None
    ordered = np.searchsorted(nodes, np.concatenate([[reference], separator, inner]))
    node_covariances = np.array([marginals.covariance([k]) for k in ordered.tolist()])
    group = np.where(known, np.cumsum(known) - 1, -1)[np.searchsorted(landmarks, seen)]
    is_known, inside = group >= 0, observations[group < 0]
    return Region(
        records, reference, separator, inner, poses[at_separator], observations[first[known]], points[landmarks[known]],
        information, -information @ step, float(least + step @ information @ step), observations[is_known],
        group[is_known], poses[np.searchsorted(nodes, inner)], inside, points[inside], graph.variable_of[inside],
        sightings[inside], uses[inner], node_covariances, problem.rows - problem.layout.pattern.n,
    )  # fmt: skip
