# SPDX-License-Identifier: Apache-2.0
"""Redundant submaps of the past, out of the estimate: a place that is seen again and again costs what it did at first.

A submap that shows nothing new, and has been left behind, is *parked*: its information is not used any more, and its
nodes move with an *anchor*, the nearest node of a submap that is not redundant, with the covariance that they had when
it was parked. It must not be needed: the submap that goes on from it has to be tied to the map by itself. Settling
takes parked submaps back.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.map_graph import MapGraph
from slam_core.geometry import FloatArray, invert_transform
from slam_core.linear_algebra.sparse_cholesky import IntArray

_ENOUGH = 6
"""Landmarks that tie a submap to the map by themselves, twice what a pose takes."""


def _none() -> IntArray:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Parked:
    """Records that are parked, with their poses relative to records that stay.

    Records (n,) with poses (n, 2, 4, 4) and covariances (n, 2, 6, 6) of their start and end ``nodes`` (n, 2), in the
    frames of the nodes ``reference`` (n,).
    """

    records: IntArray = field(default_factory=_none)
    reference: IntArray = field(default_factory=_none)
    nodes: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 2, 4, 4)))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 2, 6, 6)))

    def __len__(self) -> int:
        return len(self.records)

    def with_one(self, graph: MapGraph, record: int, reference: int, covariances: FloatArray) -> Parked:
        """And another record as it is now; ``covariances`` (2, 6, 6) of its nodes, seen from the reference."""
        nodes = np.array([[graph.records[record].start, graph.records[record].end]])
        poses = invert_transform(graph.poses[reference]) @ graph.poses[nodes]
        return Parked(
            np.append(self.records, record), np.append(self.reference, reference), np.concatenate([self.nodes, nodes]),
            np.concatenate([self.poses, poses]), np.concatenate([self.covariances, covariances[None]]),
        )  # fmt: skip

    def at(self, index: IntArray) -> Parked:
        """Some of them."""
        return Parked(
            self.records[index], self.reference[index], self.nodes[index], self.poses[index], self.covariances[index]
        )

    def node(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        """The reference of a node, T_reference_node and its covariance (6, 6); None for one of no parked record."""
        row, end = np.nonzero(self.nodes == node)
        if not len(row):
            return None
        return int(self.reference[row[0]]), self.poses[row[0], end[0]], self.covariances[row[0], end[0]]

    def carry(self, graph: MapGraph, held: IntArray) -> None:
        """Move the nodes with their references, but for those that the estimate itself ``held``."""
        moved = graph.poses[self.reference][:, None] @ self.poses
        free = ~np.isin(self.nodes, held)
        graph.poses[self.nodes[free]] = moved[free]


def is_tied(graph: MapGraph, record: int) -> bool:
    """True if a record is tied to submaps that are not redundant by enough landmarks of its own."""
    variables = graph.variable_of[graph.records[record].observations]
    owner = graph.record_of[variables]
    return int(np.count_nonzero((owner != record) & ~graph.redundant[owner])) >= _ENOUGH


def anchor_of(graph: MapGraph, record: int, nodes: IntArray) -> int | None:
    """The nearest of some nodes at which a submap of the same component starts that is not redundant."""
    fitting = (graph.component_of[graph.starts] == graph.component(record)) & ~graph.redundant
    own = np.nonzero(fitting & np.isin(graph.starts, nodes))[0]
    if not len(own):
        return None
    gap = graph.poses[graph.starts[own], :3, 3] - graph.poses[graph.records[record].start, :3, 3]
    return int(graph.starts[own[int(np.argmin(np.linalg.norm(gap, axis=1)))]])
