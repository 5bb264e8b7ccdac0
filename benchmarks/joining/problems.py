# SPDX-License-Identifier: Apache-2.0
"""Joining problems of any size with known association, shared by the benchmarks: submaps of about 60 landmarks each.

An agent walks a ring road lap after lap, so that every lap closes over the one before. The submaps come from the
feature-level world of the tests, whose covariances are exact.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TESTS = [ROOT / "test" / "sjsam_node", ROOT / "test" / "slam_experiments"]
sys.path[:0] = [str(p) for p in [*sorted((ROOT / "src").iterdir()), *TESTS]]

from submap_world import Agent, circle, ring_world  # noqa: E402

from sjsam_node.joint_problem import kernels  # noqa: E402
from sjsam_node.joint_problem.joining import JoiningProblem  # noqa: E402
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState, LocalMap, block_rows, flatten  # noqa: E402
from slam_core.geometry import so3_log  # noqa: E402
from slam_core.types import Submap  # noqa: E402
from slam_experiments.linear_slam.block_problem import BlockProblem, FlatRows, flatten_rows  # noqa: E402


@dataclass(frozen=True)
class KnownProblem:
    """Submaps with the true landmark behind each of theirs (world index), and where the agent truly was."""

    submaps: list[Submap]
    truth: list[np.ndarray]
    world_index: list[np.ndarray]

    def first(self, count: int) -> KnownProblem:
        """The first ``count`` submaps."""
        return KnownProblem(self.submaps[:count], self.truth[: count + 1], self.world_index[:count])


def ring(count: int, laps: float = 4.0, seed: int = 0, density: float = 26.0) -> KnownProblem:
    """``count`` submaps along ``laps`` laps of a ring of fitting size."""
    rng = np.random.default_rng(seed)
    radius = max(3.0, 1.0 * count / laps / (2 * np.pi))
    agent = Agent(ring_world(radius, rng, density), circle(radius, laps * 1.02 + 0.1), rng)
    submaps = agent.submaps()[:count]
    return KnownProblem(submaps, [agent.true_start(k) for k in range(count + 1)], agent.seen[:count])


def chained(problem: KnownProblem) -> np.ndarray:
    """Start poses (count + 1, 4, 4) by chaining the end poses."""
    poses = [np.eye(4)]
    for submap in problem.submaps:
        poses.append(poses[-1] @ submap.end_pose)
    return np.array(poses)


def local_maps(problem: KnownProblem, rows: str, shared_only: bool) -> tuple[list[LocalMap], JoiningState]:
    """The problem for our solver, started from chained odometry; landmarks numbered by first sight."""
    counts = np.bincount(np.concatenate(problem.world_index))
    used: dict[int, int] = {}
    poses, points, maps = chained(problem), [], []
    for k, (submap, world) in enumerate(zip(problem.submaps, problem.world_index, strict=True)):
        kept = np.nonzero(counts[world] > 1)[0] if shared_only else np.arange(len(world))
        for i in kept:
            if int(world[i]) not in used:
                used[int(world[i])] = len(used)
                points.append(poses[k][:3, :3] @ submap.landmarks[i] + poses[k][:3, 3])
        index = np.concatenate([np.arange(6), (6 + 3 * kept[:, None] + np.arange(3)).ravel()])
        mean = np.concatenate(
            [submap.end_pose[:3, 3], so3_log(submap.end_pose[:3, :3]), submap.landmarks[kept].ravel()]
        )
        information = np.linalg.inv(submap.covariance[np.ix_(index, index)])
        ids = np.array([used[int(world[i])] for i in kept], dtype=np.int64)
        local = LocalMap(k, np.array([k + 1]), ids, mean, 0.5 * (information + information.T))
        maps.append(block_rows(local, 6, 3) if rows == "block" else local)
    state = JoiningState(
        np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), np.array(points)
    )
    return maps, state


def flattened(maps: list[LocalMap], rows: str) -> FlatMaps | FlatRows:
    """The maps as our solver reads them, as a factor graph is what GTSAM reads."""
    return flatten_rows(maps, 6, 3) if rows == "block" else flatten(maps)


def joining_problem(
    flat: FlatMaps | FlatRows, state: JoiningState, backend: str = "auto"
) -> JoiningProblem | BlockProblem:
    if isinstance(flat, FlatRows):
        return BlockProblem(flat, state, np.array([0]), kernels.TANGENT, backend)
    return JoiningProblem(flat, state, np.array([0]), kernels.TANGENT, backend)
