# SPDX-License-Identifier: Apache-2.0
"""Marginal covariances of the last update, read from its factor; nothing here changes the estimate.

What the last update did not hold is answered conservatively from what it did: nodes and landmarks inside a condensed
submap, and landmarks that connect no submaps, hang on a node of the factor with the covariance of their own submaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.linalg

from sjsam_node.graph.links import Prior
from sjsam_node.graph.map_graph import MapGraph
from sjsam_node.joint_problem.joining import Marginals
from sjsam_node.smoothing.component_problem import ComponentProblem
from slam_core.geometry import FloatArray, compose_jacobians, inverse_jacobian, invert_transform, skew
from slam_core.linear_algebra.sparse_cholesky import IntArray


class ComponentMarginals:
    """Covariances of one component as of its last update, all multiplied by its variance ``factor``."""

    def __init__(
        self, graph: MapGraph, poses: FloatArray, points: FloatArray, problem: ComponentProblem, factor: float
    ) -> None:
        self.factor, self._graph, self._problem = factor, graph, problem
        self._held = set(problem.records)
        self._poses, self._points = poses, points

    @property
    def records(self) -> list[int]:
        """Records of the last update, condensed and frozen ones included, ascending."""
        inside = [i for c in self._problem.condensed for i in c.records.tolist()]
        return sorted([*self._held, *inside, *self._problem.frozen.records.tolist()])

    @cached_property
    def _marginals(self) -> Marginals:
        return self._problem.problem.marginals(self._problem.optimum)

    def node(self, node: int) -> FloatArray:
        """Covariance (6, 6) of a node that the last update held by itself."""
        return self.factor * self._problem.covariance([node])

    def ends(self, record: int) -> FloatArray:
        """Joint covariance (12, 12) of the start and end of a record."""
        r = self._graph.records[record]
        of = self._of_nodes if record in self._held else self._dependent_covariance
        return self.factor * of([r.start, r.end])

    def _of_nodes(self, nodes: Sequence[int]) -> FloatArray:
        return self._marginals.covariance(np.searchsorted(self._problem.nodes, nodes))

    def _dependent_covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Joint covariance of nodes that move with a reference, each with an error of its own."""
        jacobians, own, references = [], np.zeros((6 * len(nodes), 6 * len(nodes))), []
        for k, node in enumerate(nodes):
            moving = self._problem.moving_with(node)
            reference, T, covariance = (node, np.eye(4), np.zeros((6, 6))) if moving is None else moving
            J_reference, J_node = compose_jacobians(self._poses[reference], T)
            jacobians.append(J_reference)
            references.append(reference)
            own[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = J_node @ covariance @ J_node.T
        J = scipy.linalg.block_diag(*jacobians)
        return np.asarray(J @ self._of_nodes(references) @ J.T + own)

    def _starts(self, record: IntArray) -> FloatArray:
        """Covariance (n, 6, 6) of the start of each of some records, before the variance factor."""
        records, back = np.unique(record, return_inverse=True)
        out, is_held = np.empty((len(records), 6, 6)), np.isin(records, self._problem.records)
        held = self._graph.starts[records[is_held]]
        out[is_held] = self._marginals.pose_blocks(np.searchsorted(self._problem.nodes, held))
        if not is_held.all():
            out[~is_held] = self._dependent_covariances(self._graph.starts[records[~is_held]])
        return np.asarray(out[back])

    def _dependent_covariances(self, nodes: IntArray) -> FloatArray:
        """Covariance (n, 6, 6) of each of some nodes that move with a reference, or are held at the border of what is.

        The same as :meth:`_dependent_covariance` gives for each by itself.
        """
        still = np.eye(4), np.zeros((6, 6))
        moving = [self._problem.moving_with(n) or (n, *still) for n in nodes.tolist()]
        references, T, own = (np.array(part) for part in zip(*moving, strict=True))
        J_reference, J_node = compose_jacobians(self._poses[references], T)
        known = self._marginals.pose_blocks(np.searchsorted(self._problem.nodes, references))
        carried = J_reference @ known @ np.swapaxes(J_reference, 1, 2)
        return np.asarray(carried + J_node @ own @ np.swapaxes(J_node, 1, 2))

    def landmarks(self, observations: IntArray) -> FloatArray:
        """Covariance (n, 3, 3) in the map frame of the landmarks of some observations."""
        graph, held = self._graph, self._problem.landmarks
        variables = graph.variable_of[observations]
        at = np.searchsorted(held, variables)
        is_held = np.append(held, -1)[at] == variables
        out = np.empty((len(observations), 3, 3))
        out[is_held] = self._marginals.landmark_blocks(at[is_held])
        others = observations[~is_held]
        record = graph.record_of[others]
        pose = self._starts(record)
        T = self._poses[graph.starts[record]]
        J = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(others), 3, 3)), -skew(self._points[others] - T[:, :3, 3])], axis=2
        )
        R = T[:, :3, :3]
        out[~is_held] = J @ pose @ np.swapaxes(J, 1, 2) + R @ graph.point_covariances[others] @ np.swapaxes(R, 1, 2)
        return self.factor * out


def prior_of_pair(T_a_b: FloatArray, covariance: FloatArray) -> Prior:
    """A prior with a covariance that can be inverted: two poses that are tied exactly get a micrometre."""
    return Prior(T_a_b, covariance + 1e-12 * np.eye(6))


def relative_pose(T_map_a: FloatArray, T_map_b: FloatArray, joint: FloatArray) -> tuple[FloatArray, FloatArray]:
    """T_a_b of two poses with joint covariance (12, 12), and its covariance (6, 6)."""
    T_a_map = invert_transform(T_map_a)
    J_a, J_b = compose_jacobians(T_a_map, T_map_b)
    J = np.concatenate([J_a @ inverse_jacobian(T_map_a), J_b], axis=1)
    return T_a_map @ T_map_b, J @ joint @ J.T


def seen_from(
    T_a_b: FloatArray, covariance_ab: FloatArray, T_a_c: FloatArray, covariance_ac: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """T_b_c with covariance (6, 6), from two independent poses of one frame."""
    T_b_a, J = invert_transform(T_a_b), inverse_jacobian(T_a_b)
    J_ba, J_ac = compose_jacobians(T_b_a, T_a_c)
    covariance = J_ba @ J @ covariance_ab @ J.T @ J_ba.T + J_ac @ covariance_ac @ J_ac.T
    return np.asarray(T_b_a @ T_a_c), np.asarray(covariance)
