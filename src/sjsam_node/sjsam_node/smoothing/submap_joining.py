# SPDX-License-Identifier: Apache-2.0
"""Joins submaps to a larger one: what is inside is marginalised out, its first and second derivatives are kept."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sjsam_node.graph.landmark_sets import no_indices
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState, flatten
from sjsam_node.smoothing.assembly import local_maps, reduced_maps
from sjsam_node.smoothing.condensed import Active, CondensedSubmap
from sjsam_node.smoothing.state import EstimateState
from slam_core.geometry import FloatArray, compose_jacobians, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray

_WORTH = 0.4
"""Normal equations of a condensed submap must be smaller than this share of those of its parts together."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """Local maps of which all but a separator is to be marginalised out.

    maps, state, fixed, last, constant: the problem (:class:`JoiningProblem`); poses (p,), landmarks (l,): separator;
    root, seen_from_root: a pose, and the state in its frame, in which the covariances of all poses are wanted.
    """

    maps: FlatMaps
    state: JoiningState
    fixed: IntArray
    last: IntArray
    constant: float
    poses: IntArray
    landmarks: IntArray
    root: IntArray
    seen_from_root: JoiningState


@dataclass(frozen=True, eq=False)
class Marginal:
    """The rest of an elimination: a Gaussian over its separator of n scalars.

    step (n,), information (n, n), and chi2 at the optimum; covariances (poses, 6, 6) of all poses seen from the root;
    redundancy of the problem.
    """

    step: FloatArray
    information: FloatArray
    chi2: float
    covariances: FloatArray
    redundancy: int


T = TypeVar("T")
Eliminating = Generator[Elimination, Marginal | None, T]
"""Work that is given the marginal of each elimination that it asks for: these may be computed elsewhere."""


def marginal(wanted: Elimination) -> Marginal | None:
    """The marginal over a separator; None where it is not determined."""
    maps, state = wanted.maps, wanted.state
    problem = JoiningProblem(maps, state, wanted.fixed, kernels.TANGENT, last=wanted.last, constant=wanted.constant)
    scalars = problem.scalars(wanted.poses, wanted.landmarks)
    try:
        newton, least = problem.newton_step(state)
        step, information = newton[scalars], problem.marginal_information(state, scalars)
        seen_from_root = JoiningProblem(maps, wanted.seen_from_root, wanted.root, kernels.TANGENT)
        covariances = seen_from_root.marginals(wanted.seen_from_root).pose_blocks(np.arange(len(state.translations)))
    except ValueError:
        return None
    redundancy = problem.rows - problem.layout.pattern.n
    return Marginal(step, information, float(least + step @ information @ step), covariances, redundancy)


def join_submaps(
    state: EstimateState, records: IntArray, component: int, rows_of: str, active: Active,
    parts: Sequence[CondensedSubmap] = (),
) -> Eliminating[CondensedSubmap | None]:  # fmt: skip
    """Records and condensed submaps joined to one, where they are now.

    None where that does not pay, or is not determined.
    """
    graph = state.graph
    every = np.sort(np.concatenate([records, *(p.records for p in parts)]))
    ends, used = np.unique(np.concatenate([graph.starts[every], graph.ends[every]]), return_counts=True)
    nodes, shared = _outside(graph, records, parts)
    is_separator = (used < active.uses[ends]) | (ends == state.oldest(component).start)
    if not is_separator.any():  # landmarks alone tie it to the rest
        is_separator[np.searchsorted(ends, nodes[0])] = True
    observations = np.concatenate([graph.records[i].observations for i in every])
    seen = graph.variable_of[observations]
    landmarks, first, times = np.unique(seen, return_index=True, return_counts=True)
    known = times < active.sightings[observations[first]]
    root = int(ends[is_separator][0])
    reference = _reference(state, ends[is_separator], landmarks[known])
    separator, inner = np.setdiff1d(ends[is_separator], [reference]), ends[~is_separator]
    start = _seen_from(state, reference, nodes, shared)
    own = reduced_maps(state, records.tolist(), rows_of)
    maps = [
        *local_maps(graph, records.tolist(), own, nodes, shared),
        *(p.local_map(graph, nodes, shared) for p in parts),
    ]
    at_separator, kept = np.searchsorted(nodes, separator), np.searchsorted(shared, landmarks[known])
    rows = 6 * len(separator) + 3 * len(kept)
    if rows**2 > _WORTH * sum(len(m.mean) ** 2 for m in maps):
        return None
    fixed, last = np.searchsorted(nodes, [reference]), np.concatenate([at_separator, len(nodes) + kept])
    wanted = Elimination(
        flatten(maps), start, fixed, last, sum(p.constant for p in parts), at_separator, kept,
        np.searchsorted(nodes, [root]), _seen_from(state, root, nodes, shared),
    )  # fmt: skip
    found = yield wanted
    if found is None:
        return None
    covariances = _node_covariances(state, root, nodes, found.covariances, parts)
    group = np.where(known, np.cumsum(known) - 1, -1)[np.searchsorted(landmarks, seen)]
    is_known, inside = group >= 0, observations[group < 0]
    redundancy = found.redundancy + sum(p.redundancy for p in parts)
    T_reference = invert_transform(state.poses[reference])
    poses, points = T_reference @ state.poses, transform_points(T_reference, state.points)
    return CondensedSubmap(
        every, reference, root, separator, inner, poses[separator], observations[first[known]],
        points[landmarks[known]], found.information, -found.information @ found.step, found.chi2,
        observations[is_known], group[is_known], poses[inner], inside, points[inside], graph.variable_of[inside],
        active.sightings[inside], active.uses[inner], covariances[inner], redundancy, tuple(parts),
    )  # fmt: skip


def _seen_from(state: EstimateState, base: int, nodes: IntArray, landmarks: IntArray) -> JoiningState:
    """Estimate of nodes and landmarks in the frame of the node ``base``."""
    T_base = invert_transform(state.poses[base])
    poses = T_base @ state.poses[nodes]
    points = transform_points(T_base, state.points[landmarks])
    return JoiningState(np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), points)


def _node_covariances(
    state: EstimateState, root: int, nodes: IntArray, own: FloatArray, parts: Sequence[CondensedSubmap]
) -> FloatArray:
    """Covariances (nodes of the graph, 6, 6) in the frame of the node ``root``: ``own`` of ``nodes``, and of parts."""
    covariances = np.zeros((len(state.poses), 6, 6))
    covariances[nodes] = own
    T_root = invert_transform(state.poses[root])
    for p in parts:
        T_part = state.poses[p.root]
        inside = invert_transform(T_part) @ state.poses[p.inner]
        J_root, J_node = compose_jacobians(np.broadcast_to(T_root @ T_part, inside.shape), inside)
        covariances[p.inner] = (
            J_root @ covariances[p.root] @ np.swapaxes(J_root, 1, 2)
            + J_node @ p.node_covariances @ np.swapaxes(J_node, 1, 2)
        )  # fmt: skip
    return covariances


def _reference(state: EstimateState, separator: IntArray, landmarks: IntArray) -> int:
    """The node of a separator in whose frame what is joined is kept: its first, or the only one with landmarks near.

    What pulls at landmarks is constant in that frame. From the far end of a long way it would not turn with them, and
    a map whose new end turns by what is not known about its heading would drift away from its optimum.
    """
    gap = state.points[landmarks][:, None] - state.poses[separator][:, :3, 3]
    near = np.unique(np.argmin(np.linalg.norm(gap, axis=2), axis=1))
    return int(separator[near[0] if len(near) == 1 else 0])


def _outside(graph: MapGraph, records: IntArray, parts: Sequence[CondensedSubmap]) -> tuple[IntArray, IntArray]:
    """Nodes and landmarks that records and condensed submaps are over, ascending."""
    nodes = [graph.starts[records], graph.ends[records], *(np.append(p.separator, p.reference) for p in parts)]
    observations = np.concatenate([no_indices(), *(graph.records[i].observations for i in records)])
    connecting = observations[graph.is_connecting[observations]]
    seen = graph.variable_of[np.concatenate([connecting, *(p.landmarks for p in parts)])]
    return np.unique(np.concatenate(nodes)), np.unique(seen)
