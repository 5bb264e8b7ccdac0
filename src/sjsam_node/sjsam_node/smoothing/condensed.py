# SPDX-License-Identifier: Apache-2.0
"""A condensed submap: some submaps joined to one Gaussian over what the rest of the map shares with them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.joint_problem.problem import LocalMap
from slam_core.geometry import FloatArray, boxminus, invert_transform, transform_points
from slam_core.linear_algebra.sparse_cholesky import IntArray


@dataclass(frozen=True, eq=False)
class Active:
    """Knowledge of the submaps that take part in the estimate, without the ``frozen`` records.

    sightings (observations,) of every observation's landmark; uses (nodes,): how many submaps start or end at each
    node, one more at the end of a way, that may come.
    """

    sightings: IntArray
    uses: IntArray

    @classmethod
    def of(cls, graph: MapGraph, frozen: IntArray) -> Active:
        """As the graph is now."""
        takes_part = np.ones(len(graph.records), dtype=bool)
        takes_part[frozen] = False
        seen = np.bincount(graph.variable_of[takes_part[graph.record_of]], minlength=len(graph.record_of))
        ends = np.concatenate([graph.starts[takes_part], graph.ends[takes_part]])
        open_end = np.ones(len(graph.ending_at), dtype=bool)
        open_end[graph.starts] = False
        open_end[graph.ends[graph.is_position]] = False
        uses = np.bincount(ends, minlength=len(graph.ending_at)) + 2 * open_end
        return cls(np.asarray(seen[graph.variable_of]), np.asarray(uses))


@dataclass(frozen=True, eq=False)
class Motion:
    """Inner poses (i, 4, 4) and points (m, 3) of a condensed submap where its reference is now.

    turn: how far its separator has turned since it was condensed (rad, or m per m).
    """

    poses: FloatArray
    points: FloatArray
    turn: float


@dataclass(frozen=True, eq=False)
class CondensedSubmap:
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
    information, gradient, constant
        Over separator and landmarks: the cost is ``r^T information r + 2 gradient^T r + constant``.
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
        Condensed submaps that it was joined from, besides single submaps.
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
    gradient: FloatArray
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
    parts: tuple[CondensedSubmap, ...]

    def is_valid(self, graph: MapGraph, component_of: IntArray, active: Active, anchor: int) -> bool:
        """True if the rest of the map knows no more of it than when it was joined, and what it knows is still apart.

        ``anchor``: first node of the component.
        """
        nodes, variable_of = np.concatenate([[self.reference], self.separator, self.inner]), graph.variable_of
        sightings, uses = active.sightings, active.uses
        known = variable_of[self.landmarks]
        return bool(
            np.all(component_of[nodes] == component_of[anchor])
            and np.all(self.inner != anchor)
            and np.array_equal(uses[self.inner], self.uses)
            and np.array_equal(variable_of[self.inner_observations], self.landmark_of)
            and np.array_equal(sightings[self.inner_observations], self.sightings)
            and np.array_equal(variable_of[self.separator_observations], known[self.group])
            and len(np.unique(known)) == len(known)
        )

    def boundary_keys(self, graph: MapGraph) -> set[int]:
        """Nodes and landmarks that the rest of the map knows of it, the latter as negative numbers."""
        return {self.reference, *self.separator.tolist(), *(-1 - graph.variable_of[self.landmarks]).tolist()}

    def node(self, node: int) -> tuple[int, FloatArray, FloatArray]:
        """The root, T_root_node of a node inside, and its covariance (6, 6)."""
        k = int(np.nonzero(self.inner == node)[0][0])
        nodes = np.concatenate([[self.reference], self.separator])
        poses = np.concatenate([np.eye(4)[None], self.poses])
        T_root_reference = invert_transform(poses[int(np.nonzero(nodes == self.root)[0][0])])
        return self.root, T_root_reference @ self.inner_poses[k], self.node_covariances[k]

    def local_map(self, graph: MapGraph, nodes: IntArray, landmarks: IntArray) -> LocalMap:
        """As the joining problem takes it, over sorted lists of nodes and landmarks."""
        return LocalMap(
            int(np.searchsorted(nodes, self.reference)), np.searchsorted(nodes, self.separator),
            np.searchsorted(landmarks, graph.variable_of[self.landmarks]), self._mean, self.information, self.gradient,
        )  # fmt: skip

    @cached_property
    def _mean(self) -> FloatArray:
        return np.concatenate([boxminus(self.poses, np.eye(4)).ravel(), self.points.ravel()])

    def apply_motion(self, graph: MapGraph, poses: FloatArray, points: FloatArray) -> Motion:
        """Poses and points of what is inside, which moves with the reference, and how far the separator has turned.

        ``poses`` (nodes, 4, 4) and ``points`` (observations, 3): the estimate, of the reference and the separator.
        Inside nothing is estimated until the submaps take part again, or the whole map is asked for.
        """
        T = poses[self.reference]
        T_reference = invert_transform(T)
        shifted = transform_points(T_reference, points[graph.variable_of[self.landmarks]]) - self.points
        moved = T_reference @ poses[self.separator]
        turned = moved[:, :3, :3] @ np.swapaxes(self.poses[:, :3, :3], 1, 2) - np.eye(3)
        places = np.concatenate([np.zeros((1, 3)), self.points, self.poses[:, :3, 3]])
        extent = max(float(np.linalg.norm(np.ptp(places, axis=0))), 1.0)
        shifted = np.concatenate([moved[:, :3, 3] - self.poses[:, :3, 3], shifted])
        sheared = np.linalg.norm(shifted, axis=1).max(initial=0.0) / extent
        # The Frobenius norm of R - I is that of a rotation by an angle a: sqrt(8) sin(a / 2).
        half = np.minimum(np.linalg.norm(turned, axis=(1, 2)).max(initial=0.0) / np.sqrt(8.0), 1.0)
        turn = max(2.0 * float(np.arcsin(half)), float(sheared))
        return Motion(T @ self.inner_poses, transform_points(T, self.inner_points), turn)
