# SPDX-License-Identifier: Apache-2.0
"""A submap's landmarks as seen from its start, or from its end, with their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sjsam_node.graph.map_graph import Record
from sjsam_node.loop_closure.association import PointSet, turned
from slam_core.geometry import FloatArray, skew
from slam_core.linear_algebra.sparse_cholesky import IntArray
from slam_core.types import Submap


def at_start(record: Record) -> PointSet:
    """Landmarks of a record in its start frame."""
    submap = record.submap
    return PointSet(submap.landmarks, submap.covariance[6:, 6:], submap.descriptors)


def at_end(record: Record, index: IntArray | None = None) -> PointSet:
    """Landmarks of a record, or those at ``index``, as seen from its end pose.

    With the exact joint covariance of both (Eq. 7.2 applied to it).
    """
    submap = record.submap
    index = np.arange(len(submap.landmarks)) if index is None else index
    R, t = submap.end_pose[:3, :3], submap.end_pose[:3, 3]
    points = (submap.landmarks[index] - t) @ R
    return _PointsAtEnd(points, submap.covariance, submap.descriptors[index], submap, index)


@dataclass(frozen=True, eq=False)
class _PointsAtEnd(PointSet):
    """``covariance`` is that of the submap as it is."""

    submap: Submap
    index: IntArray

    def select(self, index: IntArray) -> PointSet:
        rows = np.concatenate([np.arange(6), self._rows(index).ravel()])
        R, J_end = self.submap.end_pose[:3, :3], self._jacobian(index).reshape(-1, 6)
        half = _as_seen(self.covariance[np.ix_(rows, rows)], R, J_end)
        return PointSet(self.points[index], _as_seen(half.T, R, J_end), self.descriptors[index])

    def variances(self) -> FloatArray:
        everything = np.arange(len(self.points))
        rows, R, J = self._rows(everything), self.submap.end_pose[:3, :3], self._jacobian(everything)
        own = R.T @ self.covariance[rows[:, :, None], rows[:, None, :]] @ R
        mixed = J @ self.covariance[:6][:, rows].transpose(1, 0, 2) @ R
        return np.asarray(own + mixed + np.swapaxes(mixed, 1, 2) + J @ self.covariance[:6, :6] @ np.swapaxes(J, 1, 2))

    def _rows(self, index: IntArray) -> IntArray:
        return np.asarray(6 + 3 * self.index[index][:, None] + np.arange(3))

    def _jacobian(self, index: IntArray) -> FloatArray:
        """Derivative (n, 3, 6) of the landmarks as seen by the end pose."""
        R, t = self.submap.end_pose[:3, :3], self.submap.end_pose[:3, 3]
        own = np.broadcast_to(-R.T, (len(index), 3, 3))
        return np.concatenate([own, R.T @ skew(self.submap.landmarks[self.index[index]] - t)], axis=2)


def _as_seen(rows: FloatArray, R: FloatArray, J_end: FloatArray) -> FloatArray:
    """``J rows`` for the Jacobian of (end pose, landmarks): ``J_end`` (3n, 6), and ``R^T`` for each landmark's own."""
    return J_end @ rows[:6] + turned(rows[6:], R.T)
