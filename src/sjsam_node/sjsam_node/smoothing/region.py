# SPDX-License-Identifier: Apache-2.0
"""A region: some submaps joined to one Gaussian over what the rest of the map shares with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing import kernels
from sjsam_node.smoothing.joining import JoiningProblem
from sjsam_node.smoothing.problem import FlatMaps, JoiningState, LocalMap, flatten
from slam_core.geometry import FloatArray, boxminus, compose_jacobians, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray

_WORTH = 0.4
"""A region's normal equations must be smaller than this share of those of its parts together."""

LocalMaps = Callable[[MapGraph, list[int], IntArray, IntArray], list[LocalMap]]
"""Local maps of records, over the nodes and landmarks of two sorted lists."""


@dataclass(frozen=True, eq=False)
class Region:
    """Records that are joined to one local map, as they were when that was done.

    Attributes
    ----------
    records
        Those joined, ascending.
    reference, separator, inner
        Nodes: the one whose frame it is, others that the rest of the map knows (k,), and those inside (i,).
    root
        The first of those that the rest of the map knows.
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
        Covariance of inner nodes in the frame of the root, (i, 6, 6).
    redundancy
        Rows of the records beyond what is unknown inside and the rows of the local map.
    parts
        Regions that it was joined from, besides single submaps.
    """

    records: IntArray
    reference: int
    root: int
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

    def node(self, node: int) -> tuple[int, FloatArray, FloatArray]:
        """The root, T_root_node of a node inside the region, and its covariance (6, 6)."""
        k = int(np.nonzero(self.inner == node)[0][0])
        nodes = np.concatenate([[self.reference], self.separator])
        poses = np.concatenate([np.eye(4)[None], self.poses])
        T_root_reference = invert_transform(poses[int(np.nonzero(nodes == self.root)[0][0])])
        return self.root, T_root_reference @ self.inner_poses[k], self.node_covariances[k]

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
    observations = np.concatenate([graph.records[i].observations for i in every])
    seen = graph.variable_of[observations]
    landmarks, first, times = np.unique(seen, return_index=True, return_counts=True)
    known = times < active.sightings[observations[first]]
    root = int(ends[is_separator][0])
    reference = _reference(graph, ends[is_separator], landmarks[known])
    separator, inner = np.setdiff1d(ends[is_separator], [reference]), ends[~is_separator]
    state = _seen_from(graph, reference, nodes, shared)
    maps = [*local_maps(graph, records.tolist(), nodes, shared), *(p.local_map(graph, nodes, shared) for p in parts)]
    at_separator, kept = np.searchsorted(nodes, separator), np.searchsorted(shared, landmarks[known])
    rows = 6 * len(separator) + 3 * len(kept)
    if rows**2 > _WORTH * sum(len(m.mean) ** 2 for m in maps):
        return None
    fixed, last = np.searchsorted(nodes, [reference]), np.concatenate([at_separator, len(nodes) + kept])
    constant = sum(p.constant for p in parts)
    flat = flatten(maps)
    problem = JoiningProblem(flat, state, fixed, kernels.TANGENT, last=last, constant=constant)
    scalars = problem.scalars(at_separator, kept)
    try:
        newton, least = problem.newton_step(state)
        step, information = newton[scalars], problem.marginal_information(state, scalars)
        covariances = _node_covariances(graph, root, nodes, shared, flat, parts)
    except ValueError:
        return None
    group = np.where(known, np.cumsum(known) - 1, -1)[np.searchsorted(landmarks, seen)]
    is_known, inside = group >= 0, observations[group < 0]
    redundancy = problem.rows - problem.layout.pattern.n + sum(p.redundancy for p in parts)
    T_reference = invert_transform(graph.poses[reference])
    poses, points = T_reference @ graph.poses, transform_points(T_reference, graph.points)
    return Region(
        every, reference, root, separator, inner, poses[separator], observations[first[known]],
        points[landmarks[known]], information, -information @ step, float(least + step @ information @ step),
        observations[is_known], group[is_known], poses[inner], inside, points[inside], graph.variable_of[inside],
        active.sightings[inside], active.uses[inner], covariances[inner], redundancy, tuple(parts),
    )  # fmt: skip


def _seen_from(graph: MapGraph, base: int, nodes: IntArray, landmarks: IntArray) -> JoiningState:
    """Estimate of nodes and landmarks in the frame of the node ``base``."""
    T_base = invert_transform(graph.poses[base])
    poses = T_base @ graph.poses[nodes]
    points = transform_points(T_base, graph.points[landmarks])
    return JoiningState(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), points)


def _node_covariances(
    graph: MapGraph, root: int, nodes: IntArray, landmarks: IntArray, maps: FlatMaps, parts: Sequence[Region]
) -> FloatArray:
    """Covariances (nodes of the graph, 6, 6) of what maps and parts are over, in the frame of the node ``root``."""
    state = _seen_from(graph, root, nodes, landmarks)
    marginals = JoiningProblem(maps, state, np.searchsorted(nodes, [root]), kernels.TANGENT).marginals(state)
    covariances = np.zeros((len(graph.poses), 6, 6))
    covariances[nodes] = marginals.pose_blocks(np.arange(len(nodes)))
    T_root = invert_transform(graph.poses[root])
    for p in parts:
        T_part = graph.poses[p.root]
        inside = invert_transform(T_part) @ graph.poses[p.inner]
        J_root, J_node = compose_jacobians(np.broadcast_to(T_root @ T_part, inside.shape), inside)
        covariances[p.inner] = (
            J_root @ covariances[p.root] @ np.swapaxes(J_root, 1, 2)
            + J_node @ p.node_covariances @ np.swapaxes(J_node, 1, 2)
        )  # fmt: skip
    return covariances


def _reference(graph: MapGraph, separator: IntArray, landmarks: IntArray) -> int:
    """The node of a separator in whose frame a region is kept: its first one, or the only one with landmarks about it.

    What pulls at landmarks is constant in that frame. From the far end of a long way it would not turn with them, and
    a map whose new end turns by what is not known about its heading would drift away from its optimum.
    """
    gap = graph.points[landmarks][:, None] - graph.poses[separator][:, :3, 3]
    near = np.unique(np.argmin(np.linalg.norm(gap, axis=2), axis=1))
    return int(separator[near[0] if len(near) == 1 else 0])


def _outside(graph: MapGraph, records: IntArray, parts: Sequence[Region]) -> tuple[IntArray, IntArray]:
    """Nodes and landmarks that records and regions are over, ascending."""
    nodes = [graph.starts[records], graph.ends[records], *(np.append(p.separator, p.reference) for p in parts)]
    observations = np.concatenate([np.empty(0, dtype=np.int64), *(graph.records[i].observations for i in records)])
    tying = observations[graph.tying()[observations]]
    seen = graph.variable_of[np.concatenate([tying, *(p.landmarks for p in parts)])]
    return np.unique(np.concatenate(nodes)), np.unique(seen)
