# SPDX-License-Identifier: Apache-2.0
"""Places of an antenna inside a submap: landmarks of it, correlated with its end and its other landmarks.

A pose on the way errs by what it hands on to the end, and by a rest (:mod:`sjsam_node.smoothing.inner_poses`); given
the end, that rest has nothing to do with the landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sjsam_node.graph.position_ids import position_ids
from sjsam_node.smoothing.inner_poses import smoothing_gains
from slam_core.geometry import FloatArray, interpolate_transform, skew
from slam_core.types import PoseEstimate, PositionReading, Submap

_LONGEST_GAP_S = 1.0
"""Poses farther apart in time do not say where the rig was between them."""
_ARM_SIGMA = 1e-3
"""Of the antenna's place on the rig (m)."""


def seen_inside(submap: Submap, readings: Sequence[PositionReading]) -> tuple[PositionReading, ...]:
    """The readings near whose stamps the submap has poses."""
    stamps = np.array([pose.stamp_ns for pose in submap.path])
    found = []
    for reading in readings:
        after = int(np.searchsorted(stamps, reading.stamp_ns))
        if 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= _LONGEST_GAP_S * 1e9:
            found.append(reading)
    return tuple(found)


def with_antenna(submap: Submap, readings: Sequence[PositionReading], arm: FloatArray) -> Submap:
    """The submap with a landmark where the antenna was at each reading, behind its own.

    ``arm``: (3,) m, of the antenna in the rig's frame.
    """
    if not readings:
        return submap
    poses = [_pose_at(submap, reading.stamp_ns) for reading in readings]
    gains, remaining = smoothing_gains(submap, poses)
    T, n, P = np.array([pose.T for pose in poses]), len(readings), submap.covariance
    arms = T[:, :3, :3] @ arm
    J = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -skew(arms)], axis=2)
    by_end = (J @ gains).reshape(3 * n, 6)
    own = by_end @ P[:6, :6] @ by_end.T
    rest = J @ remaining @ np.swapaxes(J, 1, 2) + _ARM_SIGMA**2 * np.eye(3)
    for k in range(n):
        own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += rest[k]
    cross = by_end @ P[:6]
    ids = position_ids(np.array([reading.stamp_ns for reading in readings]))
    return replace(
        submap,
        landmarks=np.concatenate([submap.landmarks, T[:, :3, 3] + arms]),
        covariance=np.block([[P, cross.T], [cross, 0.5 * (own + own.T)]]),
        landmark_ids=np.concatenate([submap.landmark_ids, ids]),
        sightings=np.concatenate([submap.sightings, np.ones(n, np.int32)]),
        descriptors=np.concatenate([submap.descriptors, np.zeros((n, submap.descriptors.shape[1]), np.float32)]),
    )


def _pose_at(submap: Submap, stamp_ns: int) -> PoseEstimate:
    """The pose inside a submap at a stamp between two of its own, with the covariance of the later one."""
    after = next(k for k, pose in enumerate(submap.path) if pose.stamp_ns >= stamp_ns)
    first, second = submap.path[after - 1], submap.path[after]
    share = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
    return PoseEstimate(stamp_ns, interpolate_transform(first.T, second.T, np.array(share)), second.covariance)
