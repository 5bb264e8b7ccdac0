# SPDX-License-Identifier: Apache-2.0
"""The facts of the map: submaps, links between them, and which of their landmarks are the same.

*Nodes* are the poses at which submaps start and end (the skeleton of chapter 7). An *observation* is one landmark of
one submap, numbered through all submaps. *Links* say that observations of two submaps are the same thing; a landmark
of the map is a set of observations that hang together by links, named after its oldest observation.

A graph is a value: what is added or removed makes another one, and whoever holds the old one has it as it was. Where
nodes and landmarks are is no fact: see :mod:`sjsam_node.smoothing.state`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from sjsam_node.graph.landmark_sets import BoolArray as BoolArray
from sjsam_node.graph.landmark_sets import LandmarkSets, no_indices
from sjsam_node.graph.links import Link
from sjsam_node.graph.selection import LinkedPairs, spread_order, variables
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers
from slam_core.types import Submap

BUILDING = "building"
"""Agent whose only submap are the tags of which it is known where they are (:mod:`sjsam_node.tags.known_tags`)."""
POSITIONS = "position/"
"""Prefix of the names of agents whose submaps are positions in a fixed frame; the rig's name follows
(:mod:`sjsam_node.positions`)."""
ALL = 1 << 30
"""Landmark budget of two submaps that all the landmarks which they share are to connect."""


@dataclass(frozen=True, eq=False)
class Record:
    """A submap in the map: its nodes and its first observation."""

    submap: Submap
    start: int
    end: int
    first_observation: int

    @property
    def key(self) -> tuple[str, int, int]:
        """Agent, session and index: unique, and an order that does not depend on when a submap arrived."""
        return self.submap.agent, self.submap.session, self.submap.index

    @property
    def frame_order(self) -> tuple[int, tuple[str, int, int]]:
        """Sort key: the first record of a component defines its frame, the building's before all others.

        Positions define none.
        """
        return 0 if self.submap.agent == BUILDING else 2 if self.is_position else 1, self.key

    @property
    def is_position(self) -> bool:
        """True if it holds positions in a fixed frame, and nothing that a camera saw."""
        return self.submap.agent.startswith(POSITIONS)

    @cached_property
    def observations(self) -> IntArray:
        """Numbers of its observations, (n,)."""
        return np.arange(self.first_observation, self.first_observation + len(self.submap.landmarks))


@dataclass(frozen=True, eq=False)
class Odometry:
    """Nodes by the end poses of their submaps alone.

    Each at ``chained`` (nodes, 4, 4) after a ``path_length`` (nodes,) m from the node ``origin`` (nodes,).
    """

    origin: IntArray = field(default_factory=no_indices)
    chained: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    path_length: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_node(self, origin: int, chained: FloatArray, path_length: float) -> Odometry:
        """Odometry with one more node."""
        return Odometry(
            np.append(self.origin, origin), np.concatenate([self.chained, chained[None]]),
            np.append(self.path_length, path_length),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MapGraph:
    """Submaps, links and landmark sets.

    Attributes
    ----------
    records, links
        All submaps and links.
    sets
        The landmark of every observation.
    starts, ends
        Nodes at which the records start and end, (records,).
    ending_at
        The record that ends at each node, -1 where a way begins, (nodes,).
    odometry
        Where the nodes are by odometry alone.
    point_covariances
        Of each observation in its submap, (observations, 3, 3).
    is_position
        Mask of those that hold positions in a fixed frame, (records,).
    budgets
        Most landmarks by which each record is connected to another one, (records,).
    least_budget
        The same for all; the larger one counts.
    """

    records: tuple[Record, ...] = ()
    links: tuple[Link, ...] = ()
    sets: LandmarkSets = field(default_factory=LandmarkSets)
    starts: IntArray = field(default_factory=no_indices)
    ends: IntArray = field(default_factory=no_indices)
    ending_at: IntArray = field(default_factory=no_indices)
    odometry: Odometry = field(default_factory=Odometry)
    point_covariances: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    is_position: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    budgets: IntArray = field(default_factory=no_indices)
    least_budget: int = 0
    _matches: LinkedPairs = field(default_factory=LinkedPairs)
    _rank: IntArray = field(default_factory=no_indices)
    _middles: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    # -- other graphs --------------------------------------------------------------------------------------------------

    def with_submap(self, submap: Submap, start: int | None, budget: int = ALL) -> MapGraph:
        """The graph with one more submap, which starts at node ``start`` or at a new one.

        ``budget`` landmarks, at most, connect it to each other one.
        """
        odometry, ending_at, number = self.odometry, self.ending_at, len(self.records)
        if start is None:
            start = len(ending_at)
            odometry, ending_at = odometry.with_node(start, np.eye(4), 0.0), np.append(ending_at, -1)
        end, step = len(ending_at), float(np.linalg.norm(submap.end_pose[:3, 3]))
        n, k = len(submap.landmarks), np.arange(len(submap.landmarks))
        own = submap.covariance[6:, 6:].reshape(n, 3, n, 3)[k, :, k, :]
        middle = np.median(submap.landmarks, axis=0) if n else np.zeros(3)
        record = Record(submap, start, end, len(self.record_of))
        return replace(
            self,
            records=(*self.records, record),
            sets=self.sets.with_submap(n, number),
            starts=np.append(self.starts, start),
            ends=np.append(self.ends, end),
            ending_at=np.append(ending_at, number),
            odometry=odometry.with_node(
                int(odometry.origin[start]), odometry.chained[start] @ submap.end_pose,
                float(odometry.path_length[start]) + step,
            ),
            point_covariances=np.concatenate([self.point_covariances, own]),
            is_position=np.append(self.is_position, record.is_position),
            budgets=np.append(self.budgets, budget),
            least_budget=0,
            _rank=np.append(self._rank, spread_order(submap.landmarks)),
            _middles=np.concatenate([self._middles, middle[None]]),
        )  # fmt: skip

    def with_record(self, number: int, record: Record) -> MapGraph:
        """The graph with a record in the place of another one that says the same."""
        return replace(self, records=(*self.records[:number], record, *self.records[number + 1 :]))

    def with_links(self, links: Sequence[Link]) -> MapGraph:
        """The graph with more links: the landmarks that their pairs name are fused."""
        added = self._observed(links)
        sets, matches = self.sets.united(added.pairs), self._matches.followed_by(added)
        return replace(self, links=(*self.links, *links), sets=sets, _matches=matches)

    def with_exactly(self, links: Sequence[Link]) -> MapGraph:
        """The graph with these links and no others: landmarks are fused anew from them."""
        matches = self._observed(links)
        return replace(self, links=tuple(links), sets=self.sets.separated().united(matches.pairs), _matches=matches)

    def with_least_budget(self, least: int) -> MapGraph:
        """The graph in which at least so many of the landmarks that two submaps share connect them."""
        return self if least == self.least_budget else replace(self, least_budget=least)

    def _observed(self, links: Sequence[Link]) -> LinkedPairs:
        """The observations that the pairs of links name."""
        if not links:
            return LinkedPairs()
        counts, ends = [len(k.pairs) for k in links], np.array([k.ends for k in links], dtype=np.int64)
        first = np.searchsorted(self.record_of, ends)
        pairs = np.concatenate([k.pairs for k in links]) + np.repeat(first, counts, axis=0)
        return LinkedPairs(pairs, pointers(counts), ends)

    # -- landmarks -----------------------------------------------------------------------------------------------------

    @property
    def observation_count(self) -> int:
        """Number of all observations."""
        return len(self.record_of)

    @property
    def landmark_of(self) -> IntArray:
        """Landmark of every observation, named after its oldest one, (observations,)."""
        return self.sets.landmark_of

    @property
    def record_of(self) -> IntArray:
        """Record of every observation, (observations,)."""
        return self.sets.record_of

    @cached_property
    def variable_of(self) -> IntArray:
        """Variable of the estimate that each observation is of, (observations,).

        One for all those of a landmark that connect submaps (:mod:`sjsam_node.graph.selection`), named after the oldest
        of them, else its own.
        """
        matches = self._matches
        budget = np.maximum(self.budgets[matches.ends].min(axis=1, initial=ALL), self.least_budget)
        return np.asarray(variables(matches.pairs, matches.ptr, budget, self.landmark_of, self._rank))

    @cached_property
    def is_connecting(self) -> BoolArray:
        """Mask (observations,) of those of a variable that connects submaps."""
        return np.bincount(self.variable_of, minlength=len(self.record_of))[self.variable_of] > 1

    def landmarks_of(self, record: int) -> IntArray:
        """Landmarks of a record's observations, (n,)."""
        return self.landmark_of[self.records[record].observations]

    def landmarks_at(self, observations: IntArray) -> IntArray:
        """Landmark of each of some observations, (n,)."""
        return self.landmark_of[observations]

    def shared_by(self, record: int) -> int:
        """Number of a record's landmarks that another record sees too."""
        return int(self.sets.is_shared[self.records[record].observations].sum())

    def records_of(self, observations: IntArray) -> IntArray:
        """Record of each of some observations, (n,)."""
        return self.record_of[observations]

    def middles_of(self, records: IntArray) -> FloatArray:
        """Median of the landmarks of some records, in their own frames, (n, 3) m."""
        return self._middles[records]

    # -- the skeleton --------------------------------------------------------------------------------------------------

    @property
    def linked(self) -> IntArray:
        """The two records of every link, (links, 2)."""
        return self._matches.ends

    def components(self) -> IntArray:
        """Component of every node, by submaps and links, (nodes,); each is named after its first node."""
        count = len(self.ending_at)
        linked = self.starts[self._matches.ends]
        a, b = np.concatenate([self.starts, linked[:, 0]]), np.concatenate([self.ends, linked[:, 1]])
        graph = scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count))
        _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
        return np.asarray(np.unique(label, return_index=True)[1][label], dtype=np.int64)

    def record_ending_at(self, node: int) -> int | None:
        """The record whose end a node is; None where a way begins."""
        found = int(self.ending_at[node])
        return None if found < 0 else found

    def path_length_between(self, first: int, second: int) -> float:
        """Length of the way that an agent went between two records, m; of both ways where they belong to two runs."""
        a, b = self.records[first], self.records[second]
        lengths = self.odometry.path_length[[a.start, b.start]]
        return float(abs(lengths[1] - lengths[0]) if a.key[:2] == b.key[:2] else sum(lengths))

    def odometry_between(self, first: IntArray, second: IntArray) -> tuple[FloatArray, FloatArray]:
        """T_first_second (n, 4, 4) of the starts of records by the end poses between them.

        NaN where nothing chains them; also the length of the way, (n,) m.
        """
        a, b, known = self.starts[first], self.starts[second], self.odometry
        T = np.linalg.inv(known.chained[a]) @ known.chained[b]
        T[known.origin[a] != known.origin[b]] = np.nan
        return T, np.abs(known.path_length[b] - known.path_length[a])
