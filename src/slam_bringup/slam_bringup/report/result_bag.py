# SPDX-License-Identifier: Apache-2.0
"""``result.mcap`` of an offline run: the topics and transforms of the nodes, for Foxglove, RViz and evo.

map -> odom is the one of the finished map, so that the trajectory shown is the smoothed one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam_bringup.bags.bag import BagWriter
from slam_bringup.bags.bag_types import BagTypes
from slam_bringup.pipeline.results import AgentResult, RunResult
from slam_core.geometry import invert_transform
from slam_core.messages import (
    ellipsoid_markers,
    header_message,
    landmark_cloud,
    occupancy_message,
    odometry_message,
    path_message,
    points_message,
    pose_stamped_message,
    pose_with_covariance_message,
    transform_message,
)
from slam_core.messages.base import Message
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate

_TYPES = BagTypes()
_Stamped = tuple[int, str, Message]


def write_result_bag(path: Path, result: RunResult) -> None:
    """Write the bag; a run without any pose gives a bag without messages."""
    messages = [m for agent in result.agents for m in _agent_messages(agent)]
    if messages:
        messages += _map_messages(result, max(stamp for stamp, _, _ in messages))
    with BagWriter(path) as bag:
        for stamp, topic, message in sorted(messages, key=lambda m: (m[0], m[1])):
            bag.write(topic, message, stamp)


def _agent_messages(agent: AgentResult) -> list[_Stamped]:
    prefix, frames = (f"/{agent.name}", f"{agent.name}/") if agent.name else ("", "")
    out: list[_Stamped] = []
    for estimate in _estimates(agent.filtered):
        out.append((estimate.stamp_ns, f"{prefix}/odom", _odometry(frames, estimate)))
    for estimate in _estimates(agent.scan_odometry):
        out.append((estimate.stamp_ns, f"{prefix}/ndt/odometry", _odometry(frames, estimate)))
    for estimate in _estimates(agent.trajectory):
        out.append((estimate.stamp_ns, f"{prefix}/pose", pose_with_covariance_message(_TYPES, "map", estimate)))
    for stamp, T in zip(agent.truth.stamps_ns.tolist(), agent.truth.poses, strict=True):
        out.append((stamp, f"{prefix}/ground_truth/pose", pose_stamped_message(_TYPES, stamp, "world", T)))
    out += _transforms(agent, prefix, frames)
    if len(agent.trajectory):
        last = int(agent.trajectory.stamps_ns[-1])
        out.append((last, f"{prefix}/map/path", path_message(_TYPES, last, "map", _estimates(agent.trajectory))))
    return out


def _odometry(frames: str, estimate: PoseEstimate) -> Message:
    return odometry_message(_TYPES, f"{frames}odom", f"{frames}base_link", estimate)


def _transforms(agent: AgentResult, prefix: str, frames: str) -> list[_Stamped]:
    out: list[_Stamped] = []
    _, joined, filtered = np.intersect1d(agent.trajectory.stamps_ns, agent.filtered.stamps_ns, return_indices=True)
    for i, j in zip(joined, filtered, strict=True):
        stamp = int(agent.trajectory.stamps_ns[i])
        T_odom_base = agent.filtered.poses[j]
        T_map_odom = agent.trajectory.poses[i] @ invert_transform(T_odom_base)
        to_odom = transform_message(_TYPES, stamp, "map", f"{frames}odom", T_map_odom)
        to_base = transform_message(_TYPES, stamp, f"{frames}odom", f"{frames}base_link", T_odom_base)
        out.append((stamp, "/tf", _TYPES.TFMessage(transforms=[to_odom, to_base])))
        out.append((stamp, f"{prefix}/map_to_odom", to_odom))
    return out


def _map_messages(result: RunResult, stamp: int) -> list[_Stamped]:
    header = header_message(_TYPES, stamp, "map")
    landmarks = result.landmarks
    ids = np.arange(len(landmarks.positions), dtype=np.int64)
    return [
        (stamp, "/map/landmarks", landmark_cloud(
            _TYPES, header, landmarks.positions, landmarks.covariances, ids, landmarks.sightings.astype(np.int32))),
        (stamp, "/map/ellipsoids", ellipsoid_markers(_TYPES, header, landmarks.positions, landmarks.covariances, ids)),
        (stamp, "/map/cloud", points_message(_TYPES, header, result.dense.points)),
        *((stamp, "/map/occupancy", occupancy_message(
            _TYPES, header, plan.cells, plan.resolution, plan.T_map_plan)) for plan in result.floor_plans[:1]),
    ]  # fmt: skip


def _estimates(trajectory: Trajectory) -> list[PoseEstimate]:
    covariances = np.zeros((len(trajectory), 6, 6)) if trajectory.covariances is None else trajectory.covariances
    return [
        PoseEstimate(int(stamp), T, P)
        for stamp, T, P in zip(trajectory.stamps_ns, trajectory.poses, covariances, strict=True)
    ]
