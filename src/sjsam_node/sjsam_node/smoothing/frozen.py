# SPDX-License-Identifier: Apache-2.0
"""Redundant submaps of the past, out of the estimate: a place that is seen again and again costs what it did at first.

A submap that shows nothing new, and has been left behind, is *frozen*: its information is not used any more, and its
nodes move with a *reference*, the nearest node of a submap that is not redundant, with the covariance that they had
when it was frozen. It must not be needed: the submap that goes on from it has to be tied to the map by itself. When the
whole map is optimised, frozen submaps take part again.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sjsam_node.graph.landmark_sets import BoolArray, no_indices
from sjsam_node.graph.map_graph import MapGraph
from slam_core.geometry import FloatArray, invert_transform
from slam_core.linear_algebra.sparse_cholesky import IntArray

_ENOUGH_LANDMARKS = 6
"""Landmarks that tie a submap to the map by themselves, twice what a pose takes."""


@dataclass(frozen=True, eq=False)
class FrozenSubmaps:
    """Records that are frozen, with their poses relative to records that are not.

    Records (n,) with poses (n, 2, 4, 4) and covariances (n, 2, 6, 6) of their start and end ``nodes`` (n, 2), in the
    frames of the nodes ``reference`` (n,).
    """

    records: IntArray = field(default_factory=no_indices)
    reference: IntArray = field(default_factory=no_indices)
    nodes: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 2, 4, 4)))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 2, 6, 6)))

    def __len__(self) -> int:
        return len(self.records)

    def with_one(
        self, record: int, nodes: IntArray, reference: int, poses: FloatArray, covariances: FloatArray
    ) -> FrozenSubmaps:
        """Frozen submaps with one more, whose two ``nodes`` stay where they are among the map's ``poses`` (n, 4, 4).

        ``covariances`` (2, 6, 6): of its nodes, seen from the reference.
        """
        own = invert_transform(poses[reference]) @ poses[nodes]
        return FrozenSubmaps(
            np.append(self.records, record), np.append(self.reference, reference),
            np.concatenate([self.nodes, nodes[None]]), np.concatenate([self.poses, own[None]]),
            np.concatenate([self.covariances, covariances[None]]),
        )  # fmt: skip

    def at(self, index: IntArray) -> FrozenSubmaps:
        """Frozen submaps at ``index``."""
        return FrozenSubmaps(
            self.records[index], self.reference[index], self.nodes[index], self.poses[index], self.covariances[index]
        )

    def of_component(self, component: int, component_of: IntArray) -> FrozenSubmaps:
        """Frozen submaps of a component."""
        return self.at(np.nonzero(component_of[self.nodes[:, 0]] == component)[0])

    def still_tied(self, component_of: IntArray) -> FrozenSubmaps:
        """Frozen submaps whose reference is in the same component as they are."""
        return self.at(np.nonzero(component_of[self.nodes[:, 0]] == component_of[self.reference])[0])

    def node(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        """The reference of a node, T_reference_node and its covariance (6, 6); None for one of no frozen record."""
        row, end = np.nonzero(self.nodes == node)
        if not len(row):
            return None
        return int(self.reference[row[0]]), self.poses[row[0], end[0]], self.covariances[row[0], end[0]]

    def apply_motion(self, poses: FloatArray, estimated: IntArray) -> tuple[IntArray, FloatArray]:
        """Nodes (k,) that move with their references, and their poses (k, 4, 4); ``estimated`` nodes do not."""
        moved = poses[self.reference][:, None] @ self.poses
        free = ~np.isin(self.nodes, estimated)
        return self.nodes[free], moved[free]


def is_tied(graph: MapGraph, redundant: BoolArray, record: int) -> bool:
    """True if a record is tied to submaps that are not redundant by enough landmarks of its own."""
    variables = graph.variable_of[graph.records[record].observations]
    owner = graph.record_of[variables]
    return int(np.count_nonzero((owner != record) & ~redundant[owner])) >= _ENOUGH_LANDMARKS
