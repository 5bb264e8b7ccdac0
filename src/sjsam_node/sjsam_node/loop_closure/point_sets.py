"""A submap's landmarks as seen from its start, or from its end, with their joint covariance."""

from __future__ import annotations

import numpy as np

from sjsam_node.graph.map_graph import Record
from sjsam_node.loop_closure.association import PointSet, turned
from slam_core.geometry import FloatArray, skew
from slam_core.linear_algebra.sparse_cholesky import IntArray


def at_start(record: Record) -> PointSet:
    """Landmarks of a record in its start frame."""
    submap = record.submap
    return PointSet(submap.landmarks, submap.covariance[6:, 6:], submap.descriptors)


def at_end(record: Record, index: IntArray | None = None) -> PointSet:
    """Landmarks of a record, or those at ``index``, as seen from its end pose, with the exact joint covariance of both
    (Eq. 7.2 applied to it).
    """
    submap = record.submap
    index = np.arange(len(submap.landmarks)) if index is None else index
    R, t = submap.end_pose[:3, :3], submap.end_pose[:3, 3]
    points = submap.landmarks[index]
    own = np.broadcast_to(-R.T, (len(points), 3, 3))
    J_end = np.concatenate([own, R.T @ skew(points - t)], axis=2).reshape(-1, 6)
    rows = np.concatenate([np.arange(6), (6 + 3 * index[:, None] + np.arange(3)).ravel()])
    half = _as_seen(submap.covariance[np.ix_(rows, rows)], R, J_end)
    return PointSet((points - t) @ R, _as_seen(half.T, R, J_end), submap.descriptors[index])


def _as_seen(rows: FloatArray, R: FloatArray, J_end: FloatArray) -> FloatArray:
    """``J rows`` for the Jacobian of (end pose, landmarks): ``J_end`` (3n, 6), and ``R^T`` for each landmark's own."""
    return J_end @ rows[:6] + turned(rows[6:], R.T)
