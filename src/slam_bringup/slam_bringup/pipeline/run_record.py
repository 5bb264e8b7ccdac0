# SPDX-License-Identifier: Apache-2.0
"""Record of a run, offline or through nodes, and the result that is made of it in one way."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.surface import Surface
from sjsam_node.smoothing.map_snapshot import MapLandmarks, MapSnapshot
from sjsam_node.tags.map_tags import MapTag, tags_text
from slam_bags.reading.sensor_bag import SensorBag
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.dense_run import dense_model
from slam_core.config import iterate_parameters
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from slam_viewer.results import EMPTY_TRAJECTORY, AgentResult, LandmarkMap, RunResult
from stereo_frontend.frame_log import LoggedFrame
from stereo_frontend.frontend_config import FrontendReport

_LOG = logging.getLogger(__name__)


class StateChanges:
    """The changes of a filter's state as lines of text, with the time since its first frame.

    Attributes
    ----------
    events
        The lines.
    lost_share
        Share of the states heard that were LOST.
    """

    def __init__(self) -> None:
        self.events: list[str] = []
        self._state = "OK"
        self._first_ns = 0
        self._heard = self._lost = 0

    @property
    def lost_share(self) -> float:
        """Share of the states heard that were LOST, 0 to 1."""
        return self._lost / max(self._heard, 1)

    def add(self, stamp_ns: int, state: str, reason: str) -> None:
        """Take the state after the frame of a stamp; 0: before the first frame."""
        if not stamp_ns:
            return
        self._first_ns = self._first_ns or stamp_ns
        self._heard += 1
        self._lost += state == "LOST"
        if state != self._state:
            self.events.append(f"{(stamp_ns - self._first_ns) / 1e9:.1f} s: {state}{f', {reason}' if reason else ''}")
        self._state = state


BACKLOG = ("received", "joined", "waiting", "waiting_at_most")
"""Numbers of submaps that ``summary.json`` gives."""


@dataclass(frozen=True, eq=False)
class AgentRecord:
    """Estimates of one agent, frame by frame.

    ``events`` are changes of its filter's state, ``lost_share`` how much of the time it was lost, ``readout_seen_s``
    the time in which its pictures are read out and its standard error, ``front_end`` what its images told,
    ``other_front_ends`` those of the other cameras of its rig by their namespaces, ``frames`` some of its pictures,
    ``rides`` the first and last stamp (ns) of its lift rides.
    """

    filtered: Sequence[PoseEstimate] = field(default_factory=list)
    scans: Sequence[PoseEstimate] = field(default_factory=list)
    feature_counts: Sequence[int] = field(default_factory=list)
    events: Sequence[str] = field(default_factory=list)
    lost_share: float = 0.0
    readout_seen_s: tuple[float, float] = (0.0, 0.0)
    front_end: FrontendReport = field(default_factory=FrontendReport)
    other_front_ends: Mapping[str, FrontendReport] = field(default_factory=dict)
    frames: Sequence[LoggedFrame] = ()
    rides: Sequence[tuple[int, int]] = ()


@dataclass(frozen=True, eq=False)
class RunRecord:
    """All agents' records, the map, and their ``trajectories`` in it by agent. ``events`` belong to no agent."""

    agents: Mapping[str, AgentRecord]
    map: MapSnapshot
    landmarks: MapLandmarks
    trajectories: Mapping[str, Sequence[PoseEstimate]]
    submaps: int
    loop_closures: int
    wall_s: float
    dropped: Mapping[str, int]
    stage_ms: Mapping[str, list[float]]
    rejections: Mapping[str, int] = field(default_factory=dict)
    events: tuple[str, ...] = ()
    solver: str = ""
    failure: str = ""
    backlog: Mapping[str, int] = field(default_factory=dict)
    tags: tuple[MapTag, ...] = ()
    fixed_frame: PoseEstimate | None = None

    def with_front_ends(
        self,
        reports: Mapping[str, FrontendReport],
        frames: Mapping[str, Sequence[LoggedFrame]] | None = None,
        rigs: Mapping[str, Sequence[str]] | None = None,
    ) -> RunRecord:
        """The record with what the agents' front ends report, and some of their pictures, by agent.

        ``rigs``: namespaces of the cameras of each agent, by default its own alone.
        """
        pictures, told = frames or {}, {}
        for agent, record in self.agents.items():
            first, *others = (rigs or {}).get(agent, (agent,))
            told[agent] = replace(
                record,
                front_end=reports[first],
                other_front_ends={camera: reports[camera] for camera in others},
                frames=pictures.get(first, ()),
            )
        return replace(self, agents=told)


_ONE_FILTER = (
    "one filter for the whole way (mapper ekf) claims less error than it makes: where covariances matter, map with "
    "submaps (--mapper sjsam, the default)"
)


def run_result(
    bag: SensorBag,
    config: SystemConfig,
    record: RunRecord,
    *,
    mapper: str,
    odometry: str,
    on_reading: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
    on_mapped: Callable[[RunResult], None] = lambda result: None,
) -> RunResult:
    """The result of a run over a bag, with the dense model on its trajectories.

    ``on_mapped`` is called with the result without a dense model; ``on_reading`` after every reading that this has
    seen, for a progress bar; then ``stopped`` is asked: whoever wants the end now does not want to wait for it.
    """
    agents = tuple(
        _agent_result(bag, config, agent, odometry, record.trajectories.get(agent, []), of_agent)
        for agent, of_agent in record.agents.items()
    )
    landmarks = record.landmarks
    stamps = [agent.filtered.stamps_ns for agent in agents if len(agent.filtered)]
    mapped = RunResult(
        bag=bag.reader.path.name,
        mode=config.feature_extractor.mode,
        mapper=mapper,
        odometry=odometry,
        agents=agents,
        map=record.map,
        landmarks=LandmarkMap(landmarks.positions, landmarks.covariances, landmarks.sightings),
        dense=Surface.empty(),
        floor_plans=(),
        submaps=record.submaps,
        loop_closures=record.loop_closures,
        frames=sum(len(s) for s in stamps),
        dropped=record.dropped,
        rejections=record.rejections,
        sensor_s=max((s[-1] - s[0]) / 1e9 for s in stamps) if stamps else 0.0,
        wall_s=record.wall_s,
        stage_ms=record.stage_ms,
        solver=record.solver,
        backlog=record.backlog,
        changed=_changed(config),
        limits=config.run,
        tags=record.tags,
        fixed_frame=record.fixed_frame,
    )
    on_mapped(mapped)
    surface, plans, failure = _dense(bag, config, record, agents, on_reading, stopped)
    doubt = (_ONE_FILTER,) * (mapper == "ekf")
    tags = tags_text(record.tags)
    told_first = (*(failure,) * bool(failure), *doubt, *(tags,) * bool(tags))
    events = _logged((*told_first, *bag.warnings, *record.events, *_events(record.agents)))
    return replace(mapped, dense=surface, floor_plans=plans, events=events, failure=failure)


def describe_error(error: Exception, consequence: str) -> str:
    """An error as one line for a person; where it came from goes to the log."""
    _LOG.debug(consequence, exc_info=error)
    kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
    return f"{consequence}: {kind}{error}"


def _logged(events: tuple[str, ...]) -> tuple[str, ...]:
    for event in events:
        _LOG.info("%s", event)
    return events


def _dense(
    bag: SensorBag,
    config: SystemConfig,
    record: RunRecord,
    agents: tuple[AgentResult, ...],
    on_reading: Callable[[], None],
    stopped: Callable[[], bool],
) -> tuple[Surface, tuple[FloorPlan, ...], str]:
    """The dense model's surface and floor plans, and why the run or the model failed, if so."""
    surface, plans, failure = Surface.empty(), tuple[FloorPlan, ...](), record.failure
    try:
        corrections = {}
        rides: dict[str, Sequence[tuple[int, int]]] = {}
        for agent, known in record.agents.items():
            corrections[bag.first_of(agent).agent] = known.front_end.correction
            corrections |= {camera: own.correction for camera, own in known.other_front_ends.items()}
            rides |= {camera: known.rides for camera in bag.rigs.get(agent, (agent,))}
        paths = {a.name: a.trajectory for a in agents}
        model = dense_model(bag, config, paths, on_reading, stopped, corrections, rides)
        if not stopped():
            surface = model.surface()
            plans = model.floor_plans(surface)
    except Exception as error:  # what was mapped is worth more than its picture
        failure = failure or describe_error(error, "no dense model was made")
    return surface, plans, failure


def _agent_result(
    bag: SensorBag, config: SystemConfig, agent: str, odometry: str, poses: Sequence[PoseEstimate], record: AgentRecord
) -> AgentResult:
    return AgentResult(
        name=agent,
        trajectory=Trajectory.from_estimates(poses),
        filtered=Trajectory.from_estimates(record.filtered),
        scan_odometry=Trajectory.from_estimates(record.scans),
        truth=bag.ground_truth(agent) or EMPTY_TRAJECTORY,
        feature_counts=np.array(record.feature_counts, dtype=np.int64),
        front_end=record.front_end,
        lost_share=record.lost_share,
        readout_seen_s=record.readout_seen_s,
        sensors=_sensors(bag, config, agent, odometry),
        frames=tuple(record.frames),
        base_frame=bag.first_of(agent).base_frame,
        mounts=_mounts(bag, agent),
    )


def _sensors(bag: SensorBag, config: SystemConfig, agent: str, odometry: str) -> tuple[str, ...]:
    """The sensors that the agent's map is made of, in words."""
    mode, dense, topics = config.feature_extractor.mode, config.dense_mapper, bag.first_of(agent).topics
    depth = "ToF camera" if bag.first_of(agent).measurement == "range" else "depth camera"
    used = ["stereo camera"] * (mode != "tof") + [depth] * (mode != "stereo" or odometry != "none")
    used += ["IMU"] * (config.ekf_slam.imu.use != "off" and bag.count(agent, "imu") > 0)
    used += ["odometry"] * (config.ekf_slam.odometry.use != "off" and bag.count(agent, "odometry") > 0)
    used += ["barometer"] * (config.ekf_slam.ride.use != "off" and bag.count(agent, "pressure") > 0)
    used += ["positions"] * (config.sjsam.position.use != "off" and bag.count(agent, "position") > 0)
    for name, wanted, role in (("stereo camera", dense.use_stereo, "right"), (depth, dense.use_tof, "depth")):
        if wanted and role in topics and name not in used:
            used.append(f"{name} for the dense model alone")
    cameras = bag.rigs.get(agent, ())
    if len(cameras) > 1:
        names = [bag.sensors[camera].camera for camera in cameras]
        used[0] = f"{len(cameras)} cameras ({', '.join(names)})"
    return tuple(used)


def _changed(config: SystemConfig) -> dict[str, Any]:
    """Parameters that are not at their defaults, by node and name."""
    defaults = {name: value for name, value, _ in iterate_parameters(SystemConfig())}
    return {name: value for name, value, _ in iterate_parameters(config) if value != defaults[name]}


def _mounts(bag: SensorBag, agent: str) -> dict[str, FloatArray]:
    """T_base_frame of the agent's own frames; those of others hang together with it only through the map."""
    sensors = bag.first_of(agent)
    return sensors.frames.below(sensors.base_frame)


def _events(agents: Mapping[str, AgentRecord]) -> list[str]:
    said = [(name, (*record.front_end.advice, *record.events)) for name, record in agents.items()]
    others = [own for record in agents.values() for own in record.other_front_ends.items()]
    said += [(camera, report.advice) for camera, report in others]
    return [f"{name}: {event}" if name else event for name, events in said for event in events]
