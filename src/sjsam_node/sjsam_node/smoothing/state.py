# SPDX-License-Identifier: Apache-2.0
"""The estimate of the map as one frozen value: where everything is, of which facts, and how it was solved.

A state is made from another one by pure functions; its arrays cannot be written to. The one before is the checkpoint:
whoever tries something and does not like it goes on from the old reference. Only
:class:`sjsam_node.smoothing.estimate.MapEstimate` says which state holds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sjsam_node.graph.landmark_sets import BoolArray, no_indices
from sjsam_node.graph.links import Link
from sjsam_node.graph.map_graph import ALL, MapGraph, Record
from sjsam_node.smoothing.component_problem import ComponentProblem, UpdateResult
from sjsam_node.smoothing.condensed import CondensedSubmap
from sjsam_node.smoothing.frozen import FrozenSubmaps
from sjsam_node.smoothing.marginals import ComponentMarginals
from sjsam_node.smoothing.reduction import RecoveredLandmarks, ReducedMap
from slam_core.geometry import FloatArray, invert_transform
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.types import Submap


@dataclass(frozen=True, eq=False)
class SolvedComponent:
    """A component's last update; its marginals are kept once somebody has asked for them."""

    problem: ComponentProblem
    result: UpdateResult
    _marginals: list[ComponentMarginals] = field(default_factory=list)

    def marginals(self, state: EstimateState) -> ComponentMarginals:
        """Covariances from the factor, multiplied by the variance factor; ``state``: any since the update."""
        if not self._marginals:
            factor = self.result.variance_factor
            self._marginals.append(ComponentMarginals(state.graph, state.poses, state.points, self.problem, factor))
        return self._marginals[0]


@dataclass(frozen=True, eq=False)
class EstimateState:
    """The estimate of a map.

    Attributes
    ----------
    graph
        The facts that it is the estimate of.
    poses, points
        T_map_node (nodes, 4, 4), and every observation's landmark (observations, 3) m.
    component_of
        The component of every node (nodes,): what hangs together by submaps and links. Each has its own frame until it
        is joined to another.
    overconfidence
        Variance factor that the matches of each record had when they were removed for contradicting each other, or 1,
        (records,).
    redundant
        Mask (records,) of submaps that show nothing new.
    last_needed
        How many submaps there were when each record was last needed by itself, (records,).
    condensed, frozen
        Records that do not take part one by one.
    solved
        The last update of every component.
    reduced, recovered
        The local maps of records that take part one by one, and their own landmarks.
    """

    graph: MapGraph = field(default_factory=MapGraph)
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    component_of: IntArray = field(default_factory=no_indices)
    overconfidence: FloatArray = field(default_factory=lambda: np.empty(0))
    redundant: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    last_needed: IntArray = field(default_factory=no_indices)
    condensed: tuple[CondensedSubmap, ...] = ()
    frozen: FrozenSubmaps = field(default_factory=FrozenSubmaps)
    solved: Mapping[int, SolvedComponent] = field(default_factory=dict)
    reduced: Mapping[int, ReducedMap] = field(default_factory=dict)
    recovered: Mapping[int, RecoveredLandmarks] = field(default_factory=dict)
    _oldest: dict[int, Record] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for array in self.arrays:
            array.flags.writeable = False

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """All arrays of the estimate itself."""
        return self.poses, self.points, self.component_of, self.overconfidence, self.redundant, self.last_needed

    # -- questions -----------------------------------------------------------------------------------------------------

    def start(self, record: int) -> FloatArray:
        """T_map_start (4, 4) of a record."""
        return np.asarray(self.poses[self.graph.records[record].start])

    def end(self, record: int) -> FloatArray:
        """T_map_end (4, 4) of a record."""
        return np.asarray(self.poses[self.graph.records[record].end])

    def start_poses(self, records: IntArray) -> FloatArray:
        """T_map_start (n, 4, 4) of some records."""
        return self.poses[self.graph.starts[records]]

    def components(self) -> list[int]:
        """All components, ascending."""
        return list(np.unique(self.component_of).tolist())

    def component(self, record: int) -> int:
        """Component that a record is in."""
        return int(self.component_of[self.graph.records[record].start])

    def records_in(self, component: int) -> list[int]:
        """Records of a component, ascending."""
        return list(np.nonzero(self.component_of[self.graph.starts] == component)[0].tolist())

    def is_redundant(self, records: IntArray | int) -> BoolArray:
        """Mask (n,) of those of some records that show nothing new; positions in a fixed frame show nothing at all."""
        return np.asarray(self.redundant[records] | self.graph.is_position[records])

    def middles(self, records: IntArray) -> FloatArray:
        """Middle of the landmarks of some records in the map frame, (n, 3); the start pose where there are none."""
        T = self.start_poses(records)
        return np.asarray((T[:, :3, :3] @ self.graph.middles_of(records)[..., None])[..., 0] + T[:, :3, 3])

    def oldest(self, component: int) -> Record:
        """The record of a component that comes first in frame order: its start defines the component's frame."""
        if component not in self._oldest:
            records = (self.graph.records[i] for i in self.records_in(component))
            self._oldest[component] = min(records, key=lambda r: r.frame_order)
        return self._oldest[component]

    def most_overconfident(self) -> tuple[float, list[int]]:
        """The largest variance factor of submaps that contradict each other, and all records that do."""
        records = np.nonzero(self.overconfidence > 1.0)[0].tolist()
        return float(self.overconfidence.max(initial=1.0)), records

    def result(self, component: int) -> UpdateResult:
        """Result of the last update of a component."""
        return self.solved[component].result

    def problem(self, component: int) -> ComponentProblem:
        """The problem of a component's last update."""
        return self.solved[component].problem

    def marginals(self, component: int) -> ComponentMarginals:
        """Covariances of a component from the factor of its last update, multiplied by its variance factor."""
        return self.solved[component].marginals(self)

    def totals(self) -> tuple[float, int]:
        """chi2 and redundancy of all components."""
        results = [s.result for s in self.solved.values()]
        return sum(r.cost for r in results), sum(r.redundancy for r in results)


# -- other facts: the estimate follows at once, and is optimised later -------------------------------------------------


def with_submap(
    state: EstimateState, submap: Submap, start: int | None, guess: FloatArray, budget: int = ALL
) -> EstimateState:
    """The state with a submap that starts at node ``start``, or at pose ``guess`` in a component of its own."""
    graph = state.graph.with_submap(submap, start, budget)
    poses, component_of = state.poses, state.component_of
    if start is None:
        component_of = np.append(component_of, len(poses))
        start, poses = len(poses), np.concatenate([poses, guess[None]])
    T, number = poses[start], len(state.graph.records)
    return replace(
        state,
        graph=graph,
        poses=np.concatenate([poses, (T @ submap.end_pose)[None]]),
        points=np.concatenate([state.points, submap.landmarks @ T[:3, :3].T + T[:3, 3]]),
        component_of=np.append(component_of, component_of[start]),
        overconfidence=np.append(state.overconfidence, 1.0),
        redundant=np.append(state.redundant, False),
        last_needed=np.append(state.last_needed, number),
        _oldest={},
    )


def with_links(state: EstimateState, links: Sequence[Link]) -> EstimateState:
    """The state with more links.

    Where the two records of one are in different components the younger one (by key) is moved onto the older.
    """
    state = replace(state, graph=state.graph.with_links(links)) if links else state
    for link in links:
        if state.component(link.first) != state.component(link.second):
            state = _merged(state, link)
    return state


def _merged(state: EstimateState, link: Link) -> EstimateState:
    first, second = state.component(link.first), state.component(link.second)
    anchor, moved, T_anchor_moved = link.first, link.second, link.T
    if state.oldest(first).frame_order > state.oldest(second).frame_order:
        first, second, anchor, moved, T_anchor_moved = second, first, moved, anchor, invert_transform(link.T)
    T_map_moved = state.start(anchor) @ T_anchor_moved
    joined = transformed(state, second, T_map_moved @ invert_transform(state.start(moved)))
    members = np.isin(state.component_of, [first, second])
    return replace(joined, component_of=np.where(members, min(first, second), state.component_of), _oldest={})


def transformed(state: EstimateState, component: int, T: FloatArray) -> EstimateState:
    """The state with a whole component transformed by ``T``, on the left."""
    nodes, poses, points = state.component_of == component, state.poses.copy(), state.points.copy()
    poses[nodes] = T @ poses[nodes]
    for i in state.records_in(component):
        rows = state.graph.records[i].observations
        points[rows] = points[rows] @ T[:3, :3].T + T[:3, 3]
    return replace(state, poses=poses, points=points)


def with_exactly(state: EstimateState, links: Sequence[Link]) -> EstimateState:
    """The state with these links and no others: components anew from submaps and links."""
    graph = state.graph.with_exactly(links)
    return replace(state, graph=graph, component_of=graph.components(), _oldest={})


def without(links: Sequence[Link], removed: Sequence[Link]) -> list[Link]:
    """The links but for those removed."""
    gone = set(removed)
    return [k for k in links if k not in gone]
