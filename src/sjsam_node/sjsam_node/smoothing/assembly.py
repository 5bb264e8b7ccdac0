# SPDX-License-Identifier: Apache-2.0
"""From the state of the map to a component's joining problem: reduced submaps, condensed ones, and their estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sjsam_node.graph import offload
from sjsam_node.graph.landmark_sets import no_indices
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import JoiningState, LocalMap, flatten, split
from sjsam_node.smoothing.component_problem import ComponentProblem
from sjsam_node.smoothing.condensed import CondensedSubmap
from sjsam_node.smoothing.frozen import FrozenSubmaps
from sjsam_node.smoothing.reduction import ReducedMap, reduce_map
from sjsam_node.smoothing.state import EstimateState
from slam_core.linear_algebra.block_pattern import IntArray, pointers


def assemble(
    state: EstimateState,
    component: int,
    rows: str,
    solver: str,
    condensed: Sequence[CondensedSubmap] = (),
    frozen: FrozenSubmaps | None = None,
) -> ComponentProblem:
    """The joining problem of a component, its frame fixed at the start of its oldest record.

    ``rows`` and ``solver`` as the estimator is configured. ``condensed`` submaps stand for their records; ``frozen``
    ones are left out.
    """
    graph, frozen = state.graph, frozen or FrozenSubmaps()
    is_inside = np.zeros(len(graph.records), dtype=bool)
    for inside in [frozen.records, *(c.records for c in condensed)]:
        is_inside[inside] = True
    records = [i for i in state.records_in(component) if not is_inside[i]]
    reduced = reduced_maps(state, records, rows)
    nodes = np.unique(
        np.concatenate([graph.starts[records], graph.ends[records], *([c.reference, *c.separator] for c in condensed)])
    ).astype(np.int64)
    observations = observations_of(graph, records, [m.shared for m in reduced])
    seen = graph.variable_of[observations]
    landmarks = np.unique(np.concatenate([seen, *(graph.variable_of[c.landmarks] for c in condensed)]))
    maps = flatten([
        *local_maps(graph, records, reduced, nodes, landmarks),
        *(c.local_map(graph, nodes, landmarks) for c in condensed),
    ])  # fmt: skip
    poses = state.poses[nodes]
    start = JoiningState(
        np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), state.points[landmarks]
    )
    anchor = np.searchsorted(nodes, [state.oldest(component).start])
    constant = sum(c.constant for c in condensed)
    problem = JoiningProblem(maps, start, anchor, kernels.TANGENT, solver, None, constant)
    dropped = [no_indices()] * len(records)
    return ComponentProblem(
        records, tuple(condensed), nodes, landmarks, reduced, observations, maps, problem, start, dropped, frozen
    )  # fmt: skip


def reduced_maps(state: EstimateState, records: Sequence[int], rows: str) -> list[ReducedMap]:
    """Reduced local maps of some records: those of the state where the same landmarks connect them still."""
    graph, known, out = state.graph, state.reduced, []
    for i in records:
        record = graph.records[i]
        connecting = graph.is_connecting[record.observations]
        reduced = known.get(i)
        if reduced is None or not np.array_equal(reduced.shared, np.nonzero(connecting)[0]):
            reduced = reduce_map(record, connecting, rows, recover=not state.redundant[i])
            offload.forget(record.submap.covariance)  # of the whole of it, two thirds of a map, none is used again
        out.append(reduced)
    return out


def with_component(
    known: Mapping[int, ReducedMap], problem: ComponentProblem, state: EstimateState
) -> dict[int, ReducedMap]:
    """Reduced maps of other components, and of those records of this one alone that take part one by one."""
    component_of, starts = state.component_of, state.graph.starts
    component = component_of[problem.nodes[0]]
    others = {i: m for i, m in known.items() if component_of[starts[i]] != component}
    return others | dict(zip(problem.records, problem.reduced, strict=True))


def observations_of(graph: MapGraph, records: Sequence[int], landmarks: list[IntArray]) -> IntArray:
    """Observations of some landmarks of each record, one record after the other."""
    own = [graph.records[i].first_observation + index for i, index in zip(records, landmarks, strict=True)]
    return np.concatenate([no_indices(), *own])


def local_maps(
    graph: MapGraph, records: Sequence[int], reduced: list[ReducedMap], nodes: IntArray, landmarks: IntArray
) -> list[LocalMap]:
    """Reduced records over sorted lists of nodes and landmarks."""
    seen = np.searchsorted(landmarks, graph.variable_of[observations_of(graph, records, [m.shared for m in reduced])])
    ids = split(seen, pointers([len(m.shared) for m in reduced]))
    index = np.asarray(records, dtype=np.int64)
    starts = np.searchsorted(nodes, graph.starts[index]).tolist()
    ends = np.searchsorted(nodes, graph.ends[index]).reshape(-1, 1)
    parts = zip(starts, ends, ids, reduced, strict=True)
    return [LocalMap(start, end, own, m.mean, m.information) for start, end, own, m in parts]
