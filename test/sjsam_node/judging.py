# SPDX-License-Identifier: Apache-2.0
"""Compares joined maps of the feature-level world with its truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from submap_world import Agent

from sjsam_node.global_map import GlobalMap, JoinReport
from slam_core.geometry import boxminus, invert_transform
from slam_core.types import Submap


def join(submaps: Iterable[Submap], global_map: GlobalMap | None = None) -> tuple[GlobalMap, list[JoinReport]]:
    global_map = global_map or GlobalMap()
    return global_map, [global_map.add(submap) for submap in submaps]


def errors(global_map: GlobalMap, agent: Agent, origin: Agent | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Pose errors (n, 6) of an agent in the frame of ``origin``'s first pose, and NEES of all but the first."""
    T = invert_transform((origin or agent).path[0])
    truth = {agent.stamp_ns + int(k * 1e8): T @ pose for k, pose in enumerate(agent.path)}
    poses = global_map.trajectory(agent.name)
    e = np.array([boxminus(truth[p.stamp_ns], p.T) for p in poses])
    moving = range(1, len(poses))
    return e, np.array([e[i] @ np.linalg.solve(poses[i].covariance, e[i]) for i in moving])


def ate(e: np.ndarray) -> float:
    return float(np.sqrt((e[:, :3] ** 2).sum(axis=1).mean()))


def chain_error(agent: Agent, submaps: list[Submap]) -> float:
    """Error of the last end pose by odometry alone, m."""
    T = agent.path[0]
    for submap in submaps:
        T = T @ submap.end_pose
    return float(np.linalg.norm(T[:3, 3] - agent.path[len(submaps) * agent.steps][:3, 3]))
