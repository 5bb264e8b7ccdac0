# SPDX-License-Identifier: Apache-2.0
"""Old submaps out of each update, so that it relinearises and refactors only what is new.

A *condensed* submap is some submaps that lie together, joined to one Gaussian over what the rest of the map shares with
them: its separator, nodes and landmarks. To the joining problem it is one more local map, in the frame of its reference
node (submaps of submaps: Ni and Dellaert 2010). Condensed submaps far from the newest submap are joined to larger ones
in turn, so that an update has few of them however large the map is. One is valid wherever later closures move it as a
whole. Once something inside it is linked to the outside, or its separator turns further than the relinearisation
threshold, its parts take part in the joining again, down to single submaps where these are what was touched, until it
has been quiet there for a while. Redundant submaps are frozen instead (:mod:`sjsam_node.smoothing.frozen`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from sjsam_node.graph.landmark_sets import no_indices
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.smoothing.condensed import Active, CondensedSubmap
from sjsam_node.smoothing.frozen import is_tied
from sjsam_node.smoothing.marginals import relative_pose
from sjsam_node.smoothing.state import EstimateState
from sjsam_node.smoothing.submap_joining import Eliminating, join_submaps
from slam_core.config import Config, parameter
from slam_core.linear_algebra.sparse_cholesky import IntArray

_COMMON_LANDMARKS = 4
"""Landmarks in common that tie two submaps together."""
_MOST_PARTS = 6
"""Condensed submaps that are joined to a larger one, at most."""
_MANY_CONDENSED = 10
"""Condensed submaps of a component from which on those far away are joined."""


@dataclass(frozen=True)
class RegionConfig(Config):
    """Parameters of condensing: which submaps are joined to larger ones until a closure needs them."""

    size: int = parameter(32, "submaps that are joined to a larger one, at most", minimum=2)
    open: int = 64
    """Submaps of a component that take part in each update one by one, about."""
    quiet: int = 10
    """Submaps that came since one was needed, before it may be joined to others."""
    relinearize: float = 0.002
    """Turn of a separator since it was linearised beyond which the parts take part again (rad), up to ``size``."""

    def largest_turn(self, condensed: CondensedSubmap) -> float:
        """``relinearize`` for any number of submaps (rad): along a way turns add up like steps of a random walk."""
        return self.relinearize * float(np.sqrt(max(len(condensed.records) / self.size, 1.0)))


def valid_submaps(state: EstimateState, component: int) -> tuple[EstimateState, list[CondensedSubmap]]:
    """Condensed submaps of a component; of those that are not valid any more the parts that are take part again."""
    active, anchor = Active.of(state.graph, state.frozen.records), state.oldest(component).start
    while True:
        own = [c for c in state.condensed if state.component_of[c.reference] == component]
        kept = [c for c in own if c.is_valid(state.graph, state.component_of, active, anchor)]
        if len(kept) == len(own):
            return state, kept
        state = expanded(state, [c for c in own if c not in kept])


def expanded(state: EstimateState, condensed: Sequence[CondensedSubmap]) -> EstimateState:
    """The state in which the parts of some condensed submaps take part again."""
    parts, last_needed = [part for c in condensed for part in c.parts], state.last_needed.copy()
    for c in condensed:
        inside = [i for part in c.parts for i in part.records.tolist()]
        last_needed[np.setdiff1d(c.records, inside)] = len(state.graph.records)
    kept = (*(c for c in state.condensed if c not in condensed), *parts)
    return replace(state, condensed=kept, last_needed=last_needed)


def fully_expanded(state: EstimateState) -> EstimateState:
    """The state in which all submaps take part one by one."""
    while state.condensed:
        state = expanded(state, state.condensed)
    return state


def condense(
    state: EstimateState, config: RegionConfig, rows: str, new: int, busy: Sequence[int]
) -> Eliminating[EstimateState]:
    """Freeze redundant submaps that are not needed, and join those that have been quiet for longest if many take part.

    ``busy`` ones stay. Of many condensed submaps those far from the newest one are joined to one, too.
    """
    busy = [new, *busy]
    out = np.concatenate([busy, state.frozen.records, *(c.records for c in state.condensed)])
    for record in np.setdiff1d(np.nonzero(state.redundant)[0], out).tolist():
        state = _frozen(state, record)
    component, active = state.component(new), Active.of(state.graph, state.frozen.records)
    is_open = state.component_of[state.graph.starts] == component
    is_open[state.frozen.records] = False
    for c in state.condensed:
        is_open[c.records] = False
    if np.count_nonzero(is_open) > config.open:
        is_open[busy] = False
        state = yield from _condense_records(state, config, rows, component, np.nonzero(is_open)[0], active)
    anchor = state.oldest(component).start
    own = [c for c in state.condensed if state.component_of[c.reference] == component]
    if len(own) > _MANY_CONDENSED:
        valid = [c for c in own if c.is_valid(state.graph, state.component_of, active, anchor)]
        state = yield from _condense_condensed(state, config, rows, component, valid, active)
    return state


def _is_quiet(state: EstimateState, config: RegionConfig, record: int) -> bool:
    return bool(len(state.graph.records) - state.last_needed[record] > config.quiet)


def _needed(state: EstimateState, records: IntArray) -> EstimateState:
    """The state in which some records are needed now."""
    last_needed = state.last_needed.copy()
    last_needed[records] = len(state.graph.records)
    return replace(state, last_needed=last_needed)


def _condense_records(
    state: EstimateState, config: RegionConfig, rows: str, component: int, records: IntArray, active: Active
) -> Eliminating[EstimateState]:
    quiet = [i for i in records.tolist() if _is_quiet(state, config, i)]
    if not quiet:
        return state
    first = min(quiet, key=lambda i: (int(state.last_needed[i]), i))
    chosen = _gathered(state, config.size, np.array(quiet), first)
    joined = yield from join_submaps(state, chosen, component, rows, active)
    return _needed(state, chosen) if joined is None else replace(state, condensed=(*state.condensed, joined))


def _condense_condensed(
    state: EstimateState,
    config: RegionConfig,
    rows: str,
    component: int,
    valid: list[CondensedSubmap],
    active: Active,
) -> Eliminating[EstimateState]:
    graph, here = state.graph, state.poses[state.graph.starts[-1], :3, 3]
    left = [c for c in valid if _is_quiet(state, config, int(c.records[0]))]
    if not left:
        return state
    parts = [max(left, key=lambda c: float(np.linalg.norm(state.poses[c.reference, :3, 3] - here)))]
    known = parts[0].boundary_keys(graph)
    while len(parts) < _MOST_PARTS:
        left = [c for c in left if c not in parts]
        nearest = max(left, key=lambda c: len(known & c.boundary_keys(graph)), default=None)
        if nearest is None or not known & nearest.boundary_keys(graph):
            break
        parts.append(nearest)
        known |= nearest.boundary_keys(graph)
    joined = None
    if len(parts) > 1:
        joined = yield from join_submaps(state, no_indices(), component, rows, active, parts)
    if joined is None:
        return _needed(state, parts[0].records[:1])
    return replace(state, condensed=(*(c for c in state.condensed if c not in parts), joined))


def _gathered(state: EstimateState, size: int, candidates: IntArray, first: int) -> IntArray:
    """Candidates nearest to one that hang together with it."""
    distance = np.linalg.norm(state.middles(candidates) - state.middles(np.array([first])), axis=1)
    nearest = np.sort(candidates[np.argsort(distance, kind="stable")[:size]])
    label = _connected(state.graph, nearest)
    return np.asarray(nearest[label == label[np.searchsorted(nearest, first)]])


def _connected(graph: MapGraph, records: IntArray) -> IntArray:
    """Label for each of some records: equal for those that hang together by nodes or enough landmarks."""
    observations = np.concatenate([graph.records[i].observations for i in records])
    rows, seen = np.searchsorted(records, graph.record_of[observations]), graph.variable_of[observations]
    B = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, seen)), (len(records), len(graph.record_of)))
    ends = np.stack([graph.starts[records], graph.ends[records]], axis=1)
    E = scipy.sparse.csr_matrix(
        (np.full(ends.size, 10.0 * _COMMON_LANDMARKS), (np.repeat(np.arange(len(records)), 2), ends.ravel())),
        (len(records), len(graph.ending_at)),
    )
    common = (B @ B.T + E @ E.T).tocsr()
    common.data[common.data < _COMMON_LANDMARKS] = 0.0
    common.eliminate_zeros()
    return np.asarray(scipy.sparse.csgraph.connected_components(common, directed=False)[1])


# -- redundant submaps -------------------------------------------------------------------------------------------------


def _frozen(state: EstimateState, record: int) -> EstimateState:
    """The state without a redundant record from here on, if the estimate does not need it."""
    graph, r, solved = state.graph, state.graph.records[record], state.solved.get(state.component(record))
    following = np.nonzero(graph.starts == r.end)[0].tolist()
    if solved is None or not all(is_tied(graph, state.redundant, i) for i in following):
        return state
    reference, nodes = _anchor_of(state, record, solved.problem.nodes), np.array([r.start, r.end])
    if reference is None or not np.isin(nodes, solved.problem.nodes).all():
        return state
    joint, covariances = solved.problem.covariance([reference, r.start, r.end]), np.empty((2, 6, 6))
    for k, node in enumerate(nodes):
        rows = np.append(np.arange(6), 6 * k + 6 + np.arange(6))
        covariances[k] = relative_pose(state.poses[reference], state.poses[node], joint[np.ix_(rows, rows)])[1]
    return replace(state, frozen=state.frozen.with_one(record, nodes, reference, state.poses, covariances))


def _anchor_of(state: EstimateState, record: int, nodes: IntArray) -> int | None:
    """The nearest of some nodes at which a submap of the same component starts that is not redundant."""
    starts = state.graph.starts
    fitting = (state.component_of[starts] == state.component(record)) & ~state.redundant
    own = np.nonzero(fitting & np.isin(starts, nodes))[0]
    if not len(own):
        return None
    gap = state.poses[starts[own], :3, 3] - state.poses[state.graph.records[record].start, :3, 3]
    return int(starts[own[int(np.argmin(np.linalg.norm(gap, axis=1)))]])
