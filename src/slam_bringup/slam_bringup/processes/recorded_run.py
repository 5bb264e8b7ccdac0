# SPDX-License-Identifier: Apache-2.0
"""From what the nodes published and saved to the same result that ``slam run`` ends with."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from sjsam_node.global_map import GlobalMap
from sjsam_node.tags.map_tags import map_tags
from slam_bags.reading.readings import AgentSensors
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames
from slam_bags.storage.bag import BagReader
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.run_record import BACKLOG, AgentRecord, RunRecord, StateChanges, run_result
from slam_bringup.processes.online_run import OnlineRun, unclean_ends
from slam_bringup.processes.start_map import StartMap
from slam_core.messages import estimate_from_message
from slam_core.types import PoseEstimate
from slam_viewer.results import STOPPED, RunResult
from stereo_frontend.frontend_config import FrontendReport
from stereo_frontend.stereo.rectification_error import RectificationError

_FIGURES = ("rectification_", "ranges_")
_LOSSES = ("lost_by_transport", "rejected", "skipped", "unpaired")


class Recording:
    """The recorded topics of a run, by agent."""

    def __init__(self, path: Path) -> None:
        self._odometry: dict[str, list[PoseEstimate]] = defaultdict(list)
        self._in_map: dict[str, dict[int, PoseEstimate]] = defaultdict(dict)
        self._feature_counts: dict[str, list[int]] = defaultdict(list)
        self.stage_ms: dict[str, list[float]] = defaultdict(list)
        self.submaps = 0
        self._states: dict[str, StateChanges] = defaultdict(StateChanges)
        self._rides: dict[str, dict[str, None]] = defaultdict(dict)
        with BagReader(path) as bag:
            for topic, _, message in bag.messages():
                if topic.endswith("/odom") or topic.endswith("/ndt/odometry"):
                    self._odometry[topic].append(estimate_from_message(message))
                elif topic.endswith("/pose"):
                    pose = estimate_from_message(message)
                    self._in_map[topic][pose.stamp_ns] = pose
                elif topic.endswith("/features"):
                    self._feature_counts[topic].append(int(message.width) * int(message.height))
                elif topic.endswith("/submap/info"):
                    self.submaps += 1
                elif topic == "/diagnostics":
                    for status in message.status:
                        values = {entry.key: entry.value for entry in status.values}
                        self._add_latency(status.name, values)
                        stamp = int(values["input_stamp_ns"])
                        self._states[status.name].add(stamp, values["state"], values["reason"])
                        self._rides[status.name] |= dict.fromkeys(values.get("lift_rides_ns", "").split())

    def of_agent(self, agent: str, camera: str) -> AgentRecord:
        """Record of one agent, as it was heard; its features are those in the namespace of its first ``camera``."""
        return AgentRecord(
            filtered=self._odometry[_topic(agent, "odom")],
            scans=self._odometry[_topic(agent, "ndt/odometry")],
            feature_counts=self._feature_counts[_topic(camera, "features")],
            events=self._states[_topic(agent, "ekf_slam")].events,
            lost_share=self._states[_topic(agent, "ekf_slam")].lost_share,
            rides=[_span(text) for text in self._rides[_topic(agent, "ekf_slam")]],
        )

    def located(self, agent: str) -> list[PoseEstimate]:
        """Poses of an agent in the map, as ``sjsam`` published them."""
        poses = self._in_map[_topic(agent, "pose")]
        return [poses[stamp] for stamp in sorted(poses)]

    def _add_latency(self, node: str, values: dict[str, str]) -> None:
        if "latency_mean_ms" in values:
            self.stage_ms[node.strip("/")].append(float(values["latency_mean_ms"]))


def collect(
    bag: Path,
    config: SystemConfig,
    run: OnlineRun,
    *,
    mapper: str,
    odometry: str,
    names: BagNames | None = None,
    start_map: StartMap | None = None,
) -> tuple[RunResult, GlobalMap]:
    """The result of a run of nodes, and the map that ``sjsam`` saved; ``start_map``: what it began with."""
    recording = Recording(run.recording)
    global_map = GlobalMap.load(run.map_folder)
    is_localized = start_map is not None and start_map.localize_only
    snapshot, landmarks = global_map.snapshot(), global_map.landmarks()
    joiner = run.diagnostics.get("/sjsam", {})
    with SensorBag(bag, names) as opened:
        record = RunRecord(
            agents={rig: recording.of_agent(rig, cameras[0]) for rig, cameras in opened.rigs.items()},
            map=snapshot,
            landmarks=landmarks,
            tags=map_tags(snapshot, landmarks),
            fixed_frame=snapshot.fixed_frame(),
            trajectories={agent: recording.located(agent) for agent in opened.rigs}
            if is_localized
            else snapshot.trajectory(start_map.submaps if start_map else 0),
            submaps=recording.submaps,
            loop_closures=int(joiner.get("localized" if is_localized else "closures", "0")),
            wall_s=run.wall_s,
            dropped=_losses(run.diagnostics),
            stage_ms=recording.stage_ms,
            backlog=_backlog(joiner),
            events=tuple([STOPPED] * run.stopped + unclean_ends(run)),
        )
        record = record.with_front_ends(
            {agent: _front_end(opened.sensors[agent], run.diagnostics) for agent in opened.agents}, rigs=opened.rigs
        )
        result = run_result(opened, config, record, mapper=mapper, odometry=odometry, stopped=lambda: run.stopped)
    return replace(result, is_localized=is_localized), global_map


def _front_end(sensors: AgentSensors, diagnostics: dict[str, dict[str, str]]) -> FrontendReport:
    """Findings about an agent's images in the last diagnostics of its ``feature_extractor``."""
    values = diagnostics.get(_topic(sensors.agent, "feature_extractor"), {})
    text, left = values.get("correction", ""), sensors.left
    correction = RectificationError.from_text(left.rectified, text) if text and left is not None else None
    rectification, ranges = (
        {key.removeprefix(prefix): _number(text) for key, text in values.items() if key.startswith(prefix)}
        for prefix in _FIGURES
    )
    advice = tuple(text for text in values.get("advice", "").split("; ") if text)
    picture, device = values.get("picture", ""), values.get("device", "cpu")
    return FrontendReport(rectification, advice, picture, correction, ranges, device)


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _backlog(values: Mapping[str, str]) -> dict[str, int]:
    """Submaps received, joined and waiting, as ``sjsam`` counts them."""
    found = {key.removeprefix("submaps ").replace(" ", "_"): key for key in values if key.startswith("submaps ")}
    return {name: int(values[found[name]]) for name in BACKLOG if name in found}


def _losses(diagnostics: dict[str, dict[str, str]]) -> dict[str, int]:
    """Losses between and in the nodes: "node: reason" to a number, where it is not zero."""
    counted = {
        f"{name.strip('/')}: {key}": int(values[key])
        for name, values in sorted(diagnostics.items())
        for key in _LOSSES
        if key in values
    }
    return {what: number for what, number in counted.items() if number}


def _span(text: str) -> tuple[int, int]:
    """First and last stamp (ns) of a lift ride, as the filter's node tells it."""
    first, _, last = text.partition("-")
    return int(first), int(last)


def _topic(agent: str, name: str) -> str:
    return f"/{agent}/{name}" if agent else f"/{name}"
