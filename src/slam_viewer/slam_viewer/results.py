# SPDX-License-Identifier: Apache-2.0
"""Result of a run and its summary, the same for ``slam run`` and ``slam nodes``."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.storeys import storey_number
from dense_mapping.reconstruction.surface import Surface
from sjsam_node.global_map import GlobalMap
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from sjsam_node.tags.map_tags import MapTag, tags_summary
from slam_core.evaluation import Evaluation, evaluate
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from slam_viewer.verdict import RunConfig, faults_of_run
from stereo_frontend.frame_log import LoggedFrame
from stereo_frontend.frontend_config import FrontendReport

EMPTY_TRAJECTORY = Trajectory.from_estimates([])
STOPPED = "stopped before the end: no dense model and no report"
"""Event of a run that a user ended early."""


@dataclass(frozen=True, eq=False)
class AgentResult:
    """One rig: its smoothed trajectory (map frame), the filter's own (odom frame), scan odometry and ground truth."""

    name: str
    trajectory: Trajectory
    filtered: Trajectory = EMPTY_TRAJECTORY
    scan_odometry: Trajectory = EMPTY_TRAJECTORY
    truth: Trajectory = EMPTY_TRAJECTORY
    feature_counts: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    front_end: FrontendReport = field(default_factory=FrontendReport)
    """Findings about the images."""
    lost_share: float = 0.0
    """Share of its frames at which it was lost."""
    readout_seen_s: tuple[float, float] = (0.0, 0.0)
    """Time from a picture's first row to its last as its frames alone show it, and its standard error, s."""
    sensors: tuple[str, ...] = ()
    """Sensors that its map is made of, in words."""
    frames: tuple[LoggedFrame, ...] = ()
    """Some of its pictures, with the features found in them."""
    base_frame: str = "base_link"
    """Frame of the rig."""
    mounts: Mapping[str, FloatArray] = field(default_factory=dict)
    """T_base_frame (4, 4) of the frames of its sensors."""

    def evaluation(self, trajectory: Trajectory | None = None) -> Evaluation | None:
        """A trajectory (by default the smoothed one) against ground truth, or None where the two do not meet."""
        trajectory = self.trajectory if trajectory is None else trajectory
        if len(self.truth) < 2 or len(trajectory) < 2:
            return None
        try:
            return evaluate(trajectory, self.truth)
        except ValueError:
            return None


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Landmarks of the joined map: positions (n, 3) m in the map frame, covariances (n, 3, 3) m2, sightings (n,)."""

    positions: FloatArray
    covariances: FloatArray
    sightings: npt.NDArray[np.int64]

    @classmethod
    def empty(cls) -> LandmarkMap:
        """A map without landmarks."""
        return cls(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class RunResult:
    """Everything a run found out.

    stage_ms: the time of every call of a stage, in order. failure: what ended the run early, "" if nothing did.
    backlog: submaps received, joined, waiting at the end, and waiting at most.
    """

    bag: str
    mode: str
    mapper: str
    odometry: str
    agents: tuple[AgentResult, ...]
    landmarks: LandmarkMap
    dense: Surface
    floor_plans: tuple[FloorPlan, ...]
    submaps: int
    loop_closures: int
    frames: int
    dropped: Mapping[str, int]
    rejections: Mapping[str, int]
    sensor_s: float
    wall_s: float
    stage_ms: Mapping[str, list[float]]
    map: MapSnapshot = field(default_factory=lambda: GlobalMap().snapshot())
    events: tuple[str, ...] = ()
    solver: str = ""
    failure: str = ""
    backlog: Mapping[str, int] = field(default_factory=dict)
    changed: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that are not at their defaults."""
    limits: RunConfig = field(default_factory=RunConfig)
    """Thresholds that it is judged by."""
    is_localized: bool = False
    """True if the agents were located in a map of an earlier run, and nothing was mapped."""
    tags: tuple[MapTag, ...] = ()
    """Fiducial tags of the map, each once for every place."""
    fixed_frame: PoseEstimate | None = None
    """T_map_frame of the frame that positions are in, where it has been determined."""


def storeys(result: RunResult) -> list[dict[str, Any]]:
    """Floors from the lowest: height (m) above that one, and the submaps on each by agent."""
    plans = result.floor_plans
    if not plans:
        return []
    found: list[dict[str, Any]] = [
        {"height_m": float(plans[0].height_of(plan.T_map_plan[None, :3, 3])[0]), "submaps": {}} for plan in plans
    ]
    for (agent, _, index), (start, _) in zip(result.map.keys, result.map.nodes if len(result.map) else (), strict=True):
        number = storey_number(plans, result.map.poses[start][:3, 3])
        if number is not None:
            found[number]["submaps"].setdefault(agent, []).append(index)
    return found


def summarise(result: RunResult) -> dict[str, Any]:
    """The content of ``summary.json``; figures against ground truth only where there is one."""
    first = result.agents[0] if result.agents else AgentResult("", EMPTY_TRAJECTORY)
    summary = {
        "bag": result.bag,
        "mode": result.mode,
        "mapper": result.mapper,
        "odometry": result.odometry,
        "frames": result.frames,
        "sensors": {agent.name: list(agent.sensors) for agent in result.agents},
        "lost_share": {agent.name: agent.lost_share for agent in result.agents},
        "dropped": int(sum(result.dropped.values())),
        "dropped_by_reason": dict(result.dropped),
        "rejections": dict(result.rejections),
        "landmarks": len(result.landmarks.positions),
        "dense_points": len(result.dense),
        "dense_triangles": len(result.dense.faces),
        "free_floor_m2": [plan.free_m2 for plan in result.floor_plans],
        "storeys": storeys(result),
        "submaps": result.submaps,
        "submap_backlog": dict(result.backlog),
        "loop_closures": result.loop_closures,
        "path_length_m": sum(agent.trajectory.length_m for agent in result.agents),
        "sensor_s": result.sensor_s,
        "wall_s": result.wall_s,
        "real_time_factor": result.sensor_s / result.wall_s if result.wall_s > 0 else 0.0,
        "stage_ms": {name: _stage(times) for name, times in result.stage_ms.items()},
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "solver": result.solver,
        "failure": result.failure,
        "changed_parameters": dict(result.changed),
        "events": list(result.events),
        **_accuracy(first, first.trajectory),
    }
    if result.is_localized:
        summary["localization"] = {agent.name: _located(agent) for agent in result.agents}
    faults = faults_of_run(summary, result.limits)
    verdict = {"state": "DEGRADED" if faults else "OK", "degraded": faults}
    return summary | verdict | _only_some_have(result, first)


def _located(agent: AgentResult) -> dict[str, float | None]:
    """Share of an agent's frames with a pose in the map, and time (s) from its first frame to the first such one."""
    frames, known = agent.filtered.stamps_ns, agent.trajectory.stamps_ns
    if not len(frames) or not len(known):
        return {"located_share": 0.0, "first_located_s": None}
    share = float(np.isin(frames, known).mean())
    return {"located_share": share, "first_located_s": float(known[0] - frames[0]) / 1e9}


def _only_some_have(result: RunResult, first: AgentResult) -> dict[str, Any]:
    """Entries of the summary that runs have by their sensors and options."""
    summary: dict[str, Any] = {}
    if len(first.scan_odometry):
        summary["scan_odometry"] = {
            "path_length_m": first.scan_odometry.length_m,
            **_accuracy(first, first.scan_odometry),
        }
    if first.front_end.picture:
        summary["features_from"] = first.front_end.picture
    if first.front_end.device != "cpu":
        summary["features_device"] = first.front_end.device
    if first.front_end.rectification:
        summary["rectification"] = dict(first.front_end.rectification)
    if first.front_end.ranges:
        summary["ranges"] = dict(first.front_end.ranges)
    if result.tags:
        summary["tags"] = tags_summary(result.tags)
    if len(first.filtered):
        summary["filtered"] = _accuracy(first, first.filtered)
    if len(result.agents) > 1:
        summary["agents"] = {
            agent.name: {"path_length_m": agent.trajectory.length_m, **_accuracy(agent, agent.trajectory)}
            for agent in result.agents
        }
    return summary


def _stage(times: list[float]) -> dict[str, float]:
    return (
        {"mean": float(np.mean(times)), "median": float(np.median(times)), "max": float(np.max(times))} if times else {}
    )


def _accuracy(agent: AgentResult, trajectory: Trajectory) -> dict[str, Any]:
    evaluation = agent.evaluation(trajectory)
    if evaluation is None:
        return {"end_error_m": None}
    return {
        "end_error_m": evaluation.end_error_m,
        "drift_percent": evaluation.drift_percent,
        "ate_rmse_m": evaluation.ate.rmse,
        "rpe": {"translation_m": evaluation.rpe.rmse, "rotation_deg": evaluation.rpe_rotation_deg.rmse},
        "anees": evaluation.anees,
        "body_offset": evaluation.body_offset,
        "chi2": None if evaluation.anees is None else [evaluation.anees_low, evaluation.anees_high],
    }
