# SPDX-License-Identifier: Apache-2.0
"""Graph of what has been joined so far: submaps, the poses between them, and which of their landmarks are the same.

*Nodes* are the poses at which submaps start and end (the skeleton of chapter 7). An *observation* is one landmark of
one submap, numbered through all submaps. *Links* say that observations of two submaps are the same thing; a landmark
of the map is a set of observations that hang together by links, named after its oldest observation. Links can be
removed, so that a closure that turns out false leaves no trace. A *component* is what hangs together by submaps
and links; each has its own frame until it is joined to another.

The poses and points are the estimate. Submaps enter it at a first guess; then :mod:`sjsam_node.smoothing` alone changes
it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from sjsam_node.graph.fusion import BoolArray as BoolArray
from sjsam_node.graph.fusion import Fusion
from sjsam_node.graph.links import Link
from sjsam_node.graph.selection import LinkedPairs, spread_order, variables
from slam_core.geometry import FloatArray, invert_transform
from slam_core.linear_algebra.block_pattern import IntArray, pointers
from slam_core.types import Submap

ALL = 1 << 30
"""Landmarks by which two submaps are tied together where all that they share are to."""


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

    @cached_property
    def observations(self) -> IntArray:
        """Numbers of its observations, (n,)."""
        return np.arange(self.first_observation, self.first_observation + len(self.submap.landmarks))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Links and estimate of a map graph at one time."""

    links: list[Link]
    matches: LinkedPairs
    poses: FloatArray
    points: FloatArray
    fusion: Fusion
    component_of: IntArray


@dataclass
class MapGraph:
    """Submaps, nodes, links and the current estimate of all of them."""

    records: list[Record] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    component_of: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _fusion: Fusion = field(default_factory=Fusion)
    _ending_at: dict[int, int] = field(default_factory=dict)
    _way: FloatArray = field(default_factory=lambda: np.empty(0))
    _chained: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    _stretch: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _middles: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    starts: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    ends: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Nodes at which the records start and end, (records,)."""
    point_covariances: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    ties: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    redundant: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    doubt: FloatArray = field(default_factory=lambda: np.empty(0))
    """Variance factor that the matches of each record had when they were let go for contradicting each other, or 1."""
    _least_ties: int = 0
    _matches: LinkedPairs = field(default_factory=LinkedPairs)
    _rank: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _variable_of: IntArray | None = None
    _oldest: dict[int, Record] = field(default_factory=dict)

    @property
    def landmark_of(self) -> IntArray:
        """Landmark of every observation, named after its oldest one, (observations,)."""
        return self._fusion.landmark_of

    @property
    def record_of(self) -> IntArray:
        """Record of every observation, (observations,)."""
        return self._fusion.record_of

    @property
    def linked(self) -> IntArray:
        """The two records of every link, (links, 2)."""
        return self._matches.ends

    @property
    def variable_of(self) -> IntArray:
        """Variable of the estimate that each observation is of, (observations,).

        One for all those of a landmark that tie submaps together (:mod:`sjsam_node.graph.selection`), named after the
        oldest of them, else its own.
        """
        if self._variable_of is None:
            matches = self._matches
            self._variable_of = variables(
                matches.pairs, matches.ptr,
                np.maximum(self.ties[matches.ends].min(axis=1, initial=ALL), self._least_ties),
                self.landmark_of, self._rank,
            )  # fmt: skip
        return self._variable_of

    def tie_by(self, least: int) -> None:
        """Let so many of the landmarks that two submaps share tie them together, or more where they were to anyway."""
        if least != self._least_ties:
            self._least_ties, self._variable_of = least, None

    def append(self, submap: Submap, start: int | None, guess: FloatArray, ties: int = ALL) -> Record:
        """Add a submap that starts at node ``start``, or at a new node at pose ``guess`` in a component of its own.

        ``ties`` landmarks, at most, tie it to each other one.
        """
        if start is None:
            start = self._new_node(guess, len(self.poses), len(self.poses), np.eye(4), 0.0)
        T, step = self.poses[start], float(np.linalg.norm(submap.end_pose[:3, 3]))
        end = self._new_node(
            T @ submap.end_pose, int(self.component_of[start]), int(self._stretch[start]),
            self._chained[start] @ submap.end_pose, float(self._way[start]) + step,
        )  # fmt: skip
        record = Record(submap, start, end, len(self.points))
        self.points = np.concatenate([self.points, submap.landmarks @ T[:3, :3].T + T[:3, 3]])
        n, k = len(submap.landmarks), np.arange(len(submap.landmarks))
        own = submap.covariance[6:, 6:].reshape(n, 3, n, 3)[k, :, k, :]
        self.point_covariances = np.concatenate([self.point_covariances, own])
        self._fusion.append(n, len(self.records))
        self._ending_at[end] = len(self.records)
        middle = np.median(submap.landmarks, axis=0) if len(submap.landmarks) else np.zeros(3)
        self._middles = np.concatenate([self._middles, middle[None]])
        self.starts, self.ends = np.append(self.starts, start), np.append(self.ends, end)
        self.ties, self._rank = np.append(self.ties, ties), np.append(self._rank, spread_order(submap.landmarks))
        self.redundant, self.doubt = np.append(self.redundant, False), np.append(self.doubt, 1.0)
        self.tie_by(0)
        self._variable_of = None
        self.records.append(record)
        known = self._oldest.get(self.component(-1))
        if known is not None and record.key < known.key:
            self._oldest.clear()
        return record

    def _new_node(self, T: FloatArray, component: int, stretch: int, chained: FloatArray, way: float) -> int:
        """Add a node at pose ``T``; by odometry it is at ``chained`` after a ``way`` (m) from node ``stretch``."""
        self.poses, self.component_of = np.concatenate([self.poses, T[None]]), np.append(self.component_of, component)
        self._chained, self._way = np.concatenate([self._chained, chained[None]]), np.append(self._way, way)
        self._stretch = np.append(self._stretch, stretch)
        return len(self.poses) - 1

    def component(self, record: int) -> int:
        """Component that a record is in."""
        return int(self.component_of[self.records[record].start])

    def records_of(self, component: int) -> list[int]:
        """Records of a component, ascending."""
        return np.nonzero(self.component_of[self.starts] == component)[0].tolist()

    def way_between(self, first: int, second: int) -> float:
        """Length of the way that an agent went between two records, m; of both ways where they belong to two runs."""
        a, b = self.records[first], self.records[second]
        ways = self._way[a.start], self._way[b.start]
        return float(abs(ways[1] - ways[0]) if a.key[:2] == b.key[:2] else sum(ways))

    def odometry_between(self, first: IntArray, second: IntArray) -> tuple[FloatArray, FloatArray]:
        """T_first_second (n, 4, 4) of the starts of records by the end poses between them.

        NaN where nothing chains them; also the length of the way, (n,) m.
        """
        a, b = self.starts[first], self.starts[second]
        T = np.linalg.inv(self._chained[a]) @ self._chained[b]
        T[self._stretch[a] != self._stretch[b]] = np.nan
        return T, np.abs(self._way[b] - self._way[a])

    def middles(self, records: IntArray) -> FloatArray:
        """Middle of the landmarks of some records in the map frame, (n, 3); the start pose where there are none."""
        T = self.poses[self.starts[records]]
        return np.asarray((T[:, :3, :3] @ self._middles[records][..., None])[..., 0] + T[:, :3, 3])

    def size(self, component: int) -> int:
        """Number of nodes of a component."""
        return int(np.count_nonzero(self.component_of == component))

    def record_ending_at(self, node: int) -> int | None:
        """The record whose end a node is; None where a way begins."""
        return self._ending_at.get(node)

    def add_link(self, link: Link) -> int:
        """Believe a link: fuse the landmarks that its pairs name; the number of pairs that could be fused.

        Where the two records are in different components the younger one (by key) is moved onto the older.
        """
        if self.component(link.first) != self.component(link.second):
            self._merge(link)
        self.links.append(link)
        self._variable_of = None
        added = self._observed([link])
        self._matches = self._matches.followed_by(added)
        return self._fusion.unite(added.pairs)

    def _observed(self, links: Sequence[Link]) -> LinkedPairs:
        """The observations that the pairs of links name."""
        if not links:
            return LinkedPairs()
        counts, ends = [len(k.pairs) for k in links], np.array([k.ends for k in links], dtype=np.int64)
        first = np.searchsorted(self.record_of, ends)
        pairs = np.concatenate([k.pairs for k in links]) + np.repeat(first, counts, axis=0)
        return LinkedPairs(pairs, pointers(counts), ends)

    def _merge(self, link: Link) -> None:
        first, second = self.component(link.first), self.component(link.second)
        T_first_second = link.T
        anchor, moved = link.first, link.second
        if self.oldest(first).key > self.oldest(second).key:
            first, second, anchor, moved = second, first, moved, anchor
            T_first_second = invert_transform(link.T)
        T_map_moved = self.poses[self.records[anchor].start] @ T_first_second
        self.move(second, T_map_moved @ invert_transform(self.poses[self.records[moved].start]))
        members = np.isin(self.component_of, [first, second])
        self.component_of[members] = min(first, second)
        self._oldest.clear()

    def oldest(self, component: int) -> Record:
        """The record of a component with the least key: its start defines the component's frame."""
        known = self._oldest.get(component)
        if known is None:
            known = min((self.records[i] for i in self.records_of(component)), key=lambda r: r.key)
            self._oldest[component] = known
        return known

    def move(self, component: int, T: FloatArray) -> None:
        """Transform the estimate of a whole component by ``T``, on the left."""
        nodes = self.component_of == component
        self.poses[nodes] = T @ self.poses[nodes]
        for i in self.records_of(component):
            rows = self.records[i].observations
            self.points[rows] = self.points[rows] @ T[:3, :3].T + T[:3, 3]

    def replace_links(self, links: Iterable[Link]) -> None:
        """Believe exactly these links (of those there were): landmarks are fused anew from them."""
        self.links = list(links)
        self._matches, self._variable_of = self._observed(self.links), None
        self._fusion.separate()
        self._fusion.unite(self._matches.pairs)
        self._split_components()

    def _split_components(self) -> None:
        """Components anew from submaps and links; each is named after its first node."""
        count = len(self.poses)
        linked = self.starts[self._matches.ends]
        a, b = np.concatenate([self.starts, linked[:, 0]]), np.concatenate([self.ends, linked[:, 1]])
        graph = scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count))
        _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
        first = np.unique(label, return_index=True)[1]
        self.component_of = first[label].astype(np.int64)
        self._oldest.clear()

    def snapshot(self) -> Snapshot:
        """The beliefs and the estimate, to come back to."""
        return Snapshot(
            list(self.links),
            self._matches,
            self.poses.copy(),
            self.points.copy(),
            self._fusion.copy(),
            self.component_of.copy(),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Back to a snapshot taken since the last submap was added."""
        self.links, self._matches = list(snapshot.links), snapshot.matches
        self._variable_of = None
        self.poses, self.points = snapshot.poses.copy(), snapshot.points.copy()
        self._fusion, self.component_of = snapshot.fusion.copy(), snapshot.component_of.copy()
        self._oldest.clear()

    def shared(self) -> BoolArray:
        """Mask (observations,) of those whose landmark more than one submap sees."""
        return self._fusion.is_shared()

    def tying(self) -> BoolArray:
        """Mask (observations,) of those of a variable that ties submaps together."""
        return np.bincount(self.variable_of, minlength=len(self.points))[self.variable_of] > 1
