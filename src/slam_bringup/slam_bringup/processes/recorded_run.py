"""From what the nodes published and saved to the same result that ``slam run`` ends with."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from dense_mapping.surface import Surface
from sjsam_node.global_map import GlobalMap
from slam_bringup.bags.bag import BagReader
from slam_bringup.bags.sensor_bag import SensorBag
from slam_bringup.bags.sensor_topics import BagNames
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_run import dense_model
from slam_bringup.pipeline.results import EMPTY_TRAJECTORY, AgentResult, LandmarkMap, RunResult
from slam_bringup.processes.interrupt import STOPPED
from slam_bringup.processes.online_run import OnlineRun, unclean_ends
from slam_core.messages import estimate_from_message
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate

_LOSSES = ("lost_by_transport", "rejected", "unpaired")


class Recording:
    """The recorded topics of a run, by agent."""

    def __init__(self, path: Path) -> None:
        self._odometry: dict[str, list[PoseEstimate]] = defaultdict(list)
        self._feature_counts: dict[str, list[int]] = defaultdict(list)
        self.stage_ms: dict[str, list[float]] = defaultdict(list)
        self.submaps = 0
        self._events: dict[str, list[str]] = defaultdict(list)
        self._states: dict[str, str] = defaultdict(lambda: "OK")
        with BagReader(path) as bag:
            for topic, _, message in bag.messages():
                if topic.endswith("/odom") or topic.endswith("/ndt/odometry"):
                    self._odometry[topic].append(estimate_from_message(message))
                elif topic.endswith("/features"):
                    self._feature_counts[topic].append(int(message.width) * int(message.height))
                elif topic.endswith("/submap/info"):
                    self.submaps += 1
                elif topic == "/diagnostics":
                    for status in message.status:
                        values = {entry.key: entry.value for entry in status.values}
                        self._add_latency(status.name, values)
                        self._add_event(status.name, values)

    def odometry(self, agent: str, name: str) -> Trajectory:
        """Poses on ``odom`` or ``ndt/odometry`` of an agent."""
        return Trajectory.from_estimates(self._odometry[_topic(agent, name)])

    def feature_counts(self, agent: str) -> list[int]:
        """Number of features of each frame."""
        return self._feature_counts[_topic(agent, "features")]

    def events(self, agent: str) -> list[str]:
        """Changes of state of the agent's filter, as in the offline run."""
        return self._events[_topic(agent, "ekf_slam")]

    def _add_latency(self, node: str, values: dict[str, str]) -> None:
        if "latency_mean_ms" in values:
            self.stage_ms[node.strip("/")].append(float(values["latency_mean_ms"]))

    def _add_event(self, node: str, values: dict[str, str]) -> None:
        state = values["state"]
        if state != self._states[node]:
            reason = f": {values['reason']}" if values["reason"] else ""
            self._events[node].append(f"{int(values['input_stamp_ns']) / 1e9:.3f} s, {state}{reason}")
        self._states[node] = state


def collect(
    bag: Path, config: SystemConfig, run: OnlineRun, *, mapper: str, odometry: str, names: BagNames | None = None
) -> tuple[RunResult, GlobalMap]:
    """The result of a run of nodes, and the map that ``sjsam`` saved."""
    recording = Recording(run.recording)
    global_map = GlobalMap.load(run.map_folder)
    with SensorBag(bag, names) as opened:
        agents = tuple(_agent_result(agent, opened, recording, global_map) for agent in opened.agents)
        # Who wants the end now does not want to wait for the dense model.
        dense = (
            Surface.empty()
            if run.stopped
            else dense_model(opened, config, {a.name: a.trajectory for a in agents}).surface()
        )
    landmarks = global_map.landmarks()
    stamps = [a.filtered.stamps_ns for a in agents if len(a.filtered)]
    result = RunResult(
        bag=bag.name,
        mode=config.feature_extractor.mode,
        mapper=mapper,
        odometry=odometry,
        agents=agents,
        landmarks=LandmarkMap(landmarks.positions, landmarks.covariances, landmarks.sightings.astype(np.int32)),
        dense=dense,
        submaps=recording.submaps,
        loop_closures=int(run.diagnostics.get("/sjsam", {}).get("closures", "0")),
        frames=sum(len(s) for s in stamps),
        dropped=_losses(run.diagnostics),
        rejections={},
        sensor_s=max((s[-1] - s[0]) / 1e9 for s in stamps) if stamps else 0.0,
        wall_s=run.wall_s,
        stage_ms=recording.stage_ms,
        events=tuple([STOPPED] * run.stopped + opened.warnings + _events(agents, recording) + unclean_ends(run)),
    )
    return result, global_map


def _agent_result(agent: str, bag: SensorBag, recording: Recording, global_map: GlobalMap) -> AgentResult:
    return AgentResult(
        name=agent,
        trajectory=Trajectory.from_estimates(global_map.trajectory(agent)),
        filtered=recording.odometry(agent, "odom"),
        scan_odometry=recording.odometry(agent, "ndt/odometry"),
        truth=bag.ground_truth(agent) or EMPTY_TRAJECTORY,
        feature_counts=np.array(recording.feature_counts(agent), dtype=np.int64),
    )


def _events(agents: tuple[AgentResult, ...], recording: Recording) -> list[str]:
    return [f"{a.name}: {e}" if a.name else e for a in agents for e in recording.events(a.name)]


def _losses(diagnostics: dict[str, dict[str, str]]) -> dict[str, int]:
    """What was lost between and in the nodes: "node: reason" to a number, where it is not zero."""
    counted = {
        f"{name.strip('/')}: {key}": int(values[key])
        for name, values in sorted(diagnostics.items())
        for key in _LOSSES
        if key in values
    }
    return {what: number for what, number in counted.items() if number}


def _topic(agent: str, name: str) -> str:
    return f"/{agent}/{name}" if agent else f"/{name}"
