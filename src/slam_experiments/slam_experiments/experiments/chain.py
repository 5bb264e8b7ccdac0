# SPDX-License-Identifier: Apache-2.0
"""Jobs that map a scenario's bag with the whole chain, and what they keep of a run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_bringup.pipeline.configuration import choose, load_system_config
from slam_bringup.pipeline.offline import run_bag
from slam_core.evaluation import associate
from slam_core.geometry import FloatArray, transform_points
from slam_experiments.job import EVERYTHING, Job, Kept
from slam_experiments.simulated.rendering import rendered
from slam_viewer.results import AgentResult, RunResult, summarise

MODULE = "slam_experiments.experiments.chain"


def mapped(
    scenario: str,
    mode: str = "stereo",
    *,
    mapper: str = "sjsam",
    odometry: str = "none",
    every: int = 1,
    frames: int | None = None,
) -> Job:
    """The whole chain on a scenario."""
    arguments = {"mode": mode, "mapper": mapper, "odometry": odometry}
    return Job(f"{MODULE}:map_bag", arguments, EVERYTHING, (rendered(scenario, every, frames),))


def map_bag(folder: Path, before: list[Path], mode: str, mapper: str, odometry: str) -> Kept:
    """Map the bag that the job before has rendered."""
    config = choose(load_system_config(None), mode, mapper, odometry)
    began = time.process_time()
    result, _ = run_bag(before[0] / "bag", config, mapper=mapper, odometry=odometry)
    processor_s = time.process_time() - began
    arrays: dict[str, npt.NDArray[Any]] = {
        "landmarks": result.landmarks.positions,
        "landmark_covariances": result.landmarks.covariances,
        "dense_points": result.dense.points[:: max(1, len(result.dense) // 100_000)],
        **_submap_arrays(result.map),
        **{f"ms {name}": np.array(ms) for name, ms in result.stage_ms.items()},
    }
    for k, agent in enumerate(result.agents):
        arrays |= _agent_arrays(agent, f"{k} ")
    return {"summary": summarise(result), "agents": _agent_values(result), "processor_s": processor_s}, arrays


def _agent_values(result: RunResult) -> list[dict[str, Any]]:
    """Name and accuracy of each agent: joined, and of the filter alone."""
    values = []
    for agent in result.agents:
        joined, filtered = agent.evaluation(), agent.evaluation(agent.filtered)
        values.append(
            {
                "name": agent.name,
                "path_m": agent.trajectory.length_m,
                **{f"{name}_{key}": value for name, e in (("joined", joined), ("filter", filtered)) if e is not None
                   for key, value in (("ate_m", e.ate.rmse), ("end_m", e.end_error_m), ("end_deg", e.end_error_deg),
                                      ("anees", e.anees))},
            }
        )  # fmt: skip
    return values


def _agent_arrays(agent: AgentResult, prefix: str) -> dict[str, npt.NDArray[Any]]:
    """Trajectory, its covariances and the truth where the two meet; the filter's; scan odometry's."""
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, trajectory in (("joined", agent.trajectory), ("filter", agent.filtered), ("scans", agent.scan_odometry)):
        if len(trajectory) < 2:
            continue
        poses = trajectory.poses
        if len(agent.truth) > 1:
            trajectory, truth = associate(trajectory, agent.truth)
            arrays[f"{prefix}{name} truth"], poses = truth, trajectory.poses
        arrays[f"{prefix}{name} poses"] = poses
        arrays[f"{prefix}{name} time"] = (trajectory.stamps_ns - trajectory.stamps_ns[0]) / 1e9
        if trajectory.covariances is not None:
            arrays[f"{prefix}{name} covariances"] = trajectory.covariances
    return arrays


def _submap_arrays(snapshot: MapSnapshot) -> dict[str, npt.NDArray[Any]]:
    """Landmarks of the submaps as the filter chained them and as they are joined, their submap and landmark numbers.

    The last two give the pattern of the measurement matrix (Fig. 9.23): a row per observation of a submap.
    """
    if not len(snapshot):
        return {}
    chained, T, run = [], np.eye(4), snapshot.keys[0][:2]
    for submap, key in zip(snapshot.submaps, snapshot.keys, strict=True):
        if key[:2] != run:
            run, T = key[:2], np.eye(4)
        chained.append(transform_points(T, submap.landmarks))
        T = T @ submap.end_pose
    return {
        "submap_of": snapshot.submap_of,
        "landmark_of": snapshot.landmark_of,
        "chained": np.concatenate(chained),
        "joined": snapshot.points,
        "start poses": snapshot.poses[snapshot.nodes[:, 0]],
    }


def yaw(poses: FloatArray) -> FloatArray:
    """Heading (n,) rad of poses (n, 4, 4), without jumps."""
    return np.asarray(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
