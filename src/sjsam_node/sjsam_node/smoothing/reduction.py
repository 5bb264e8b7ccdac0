# SPDX-License-Identifier: Apache-2.0
"""Submaps without the landmarks that connect them to no other.

A landmark that connects no submaps constrains nothing. It is marginalised out of its submap before joining (a
Gaussian's rows are dropped) and recovered afterwards from its correlation with what was joined, both exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sjsam_node.graph.map_graph import BoolArray, Record
from sjsam_node.joint_problem.problem import LocalMap, block_rows
from slam_core.geometry import FloatArray, so3_log
from slam_core.linear_algebra import blas
from slam_core.linear_algebra.block_pattern import IntArray


@dataclass(frozen=True, eq=False)
class ReducedMap:
    """A submap without the landmarks that connect it to no other.

    shared, private: indices of its landmarks. mean (m,) of (end position, end rotation vector, shared landmarks) and
    information (m, m). cross (3p, m): covariance of the private landmarks with what was kept, None where they are not
    recovered.
    """

    shared: IntArray
    private: IntArray
    mean: FloatArray
    information: FloatArray
    cross: FloatArray | None


def reduce_map(record: Record, is_shared: BoolArray, rows: str, *, recover: bool = True) -> ReducedMap:
    """Marginalise the private landmarks of a record out."""
    submap = record.submap
    shared, private = np.nonzero(is_shared)[0], np.nonzero(~is_shared)[0]
    kept = np.concatenate([np.arange(6), (6 + 3 * shared[:, None] + np.arange(3)).ravel()])
    end = submap.end_pose
    mean = np.concatenate([end[:3, 3], so3_log(end[:3, :3]), submap.landmarks[shared].ravel()])
    information = blas.inverse(submap.covariance[np.ix_(kept, kept)])
    if rows == "block":
        information = block_rows(LocalMap(0, np.array([1]), shared, mean, information), 6, 3).information
    if rows == "block" or not recover:
        return ReducedMap(shared, private, mean, information, None)
    dropped = (6 + 3 * private[:, None] + np.arange(3)).ravel()
    return ReducedMap(shared, private, mean, information, submap.covariance[np.ix_(dropped, kept)])


@dataclass(frozen=True, eq=False)
class RecoveredLandmarks:
    """Private landmarks (p, 3) of a reduced submap in its frame, and the residual that they were recovered from."""

    reduced: ReducedMap
    residual: FloatArray
    weighted: FloatArray
    private: FloatArray
