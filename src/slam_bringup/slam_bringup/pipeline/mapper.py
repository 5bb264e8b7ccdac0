# SPDX-License-Identifier: Apache-2.0
"""The filters of all agents and the session of the one map that their submaps go to.

The session has a thread of its own (:mod:`sjsam_node.session.map_session`). Where the nodes would send compact
submaps, their rounding is in the map here too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import Future

from ekf_slam_node.stage import FilterStage, FrameResult
from ndt_registration.stage import ScanEstimate
from sjsam_node.agents import in_order
from sjsam_node.positions.position_links import positions_text
from sjsam_node.session.map_session import MapSession, Mode, Outcome
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from sjsam_node.tags.map_tags import map_tags
from slam_bags.reading.readings import AgentSensors, SessionStart
from slam_bringup.pipeline.configuration import SystemConfig, filter_config
from slam_bringup.pipeline.rig_sessions import RigSessions
from slam_bringup.pipeline.run_record import BACKLOG, AgentRecord, RunRecord, StateChanges
from slam_bringup.pipeline.sensor_pipeline import AgentItem, Value
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.messages import motion_as_received, rounded
from slam_core.runtime.memory import leave_libraries
from slam_core.types import (
    Features,
    ImuSample,
    OdometryReading,
    PoseEstimate,
    PositionReading,
    PressureReading,
    Submap,
)

_LOADED = 4
"""Frames of an agent after which the kernels of images and filter are loaded."""


class Mapper:
    """Takes the inputs of all filters in order, and hands every submap that one of them finishes to the session.

    Parameters
    ----------
    sensors
        What each agent carries, by name; those of the cameras of one rig feed one filter.
    """

    def __init__(
        self, config: SystemConfig, sensors: Mapping[str, AgentSensors], times: StageTimes, session: MapSession
    ) -> None:
        self._times = times
        self.session = session
        self._compact = config.ekf_slam.submap.compact
        rigs = _rigs(sensors)
        self._filters = {
            rig: FilterStage(filter_config(config.ekf_slam, *s), s[0].frames, s[0].base_frame, session.next_session)
            for rig, s in rigs.items()
        }
        self._cameras = {own.agent: (rig, own.camera) for rig, s in rigs.items() for own in s}
        self._sessions = {rig: RigSessions(own.camera for own in s) for rig, s in rigs.items()}
        self._diaries = {rig: _Diary() for rig in rigs}
        self._futures: list[Future[Outcome | None]] = []
        self._outcomes: list[Outcome] = []
        self._events: list[str] = []
        self._uses_positions, self._has_positions = config.sjsam.position.use != "off", False

    def process(self, item: AgentItem) -> None:
        """One step of one agent's filter, and of the map where that finished a submap."""
        agent, camera = self._cameras[item.agent]
        stage, value = self._filters[agent], item.value
        if isinstance(value, SessionStart):
            if not self._sessions[agent].begins(camera):
                stage.restart_camera(camera)
                return
            self._process_waiting(agent)
            self._diaries[agent].rides += stage.ride_spans
            self._hand_over(stage.start_session())
        elif isinstance(value, PositionReading):
            self._has_positions = self._uses_positions
            self.session.add_position(agent, value)
        elif isinstance(value, ScanEstimate):
            self._diaries[agent].scans.append(value.pose)
        add_to_filter(stage, value, camera)
        self._take_results(agent)

    def finish(self) -> None:
        """Close the open submaps and wait until all are joined; the map ends up the same whoever came first.

        A submap whose joining failed is left out of the map; the events say so.
        """
        last: list[Submap] = []
        for agent, stage in self._filters.items():
            self._process_waiting(agent)
            for text in filter(None, (stage.diagnostic, stage.moving_objects)):
                self._events.append(f"{agent}: {text}" if agent else text)
            self._diaries[agent].readout_seen_s = stage.readout_seen_s
            self._diaries[agent].rides += stage.ride_spans
            last += stage.start_session()  # which no frame begins: the filter forgets its state
        self._hand_over(in_order(last))
        self.session.finish().result()
        for future in self._futures:
            if (error := future.exception()) is not None:
                self._events.append(f"a submap could not be joined: {error!r}")
            elif (outcome := future.result()) is not None:
                self._outcomes.append(outcome)
                self._times.ms["sjsam"].append(1e3 * outcome.duration_s)
        self._events += self._warnings()

    def _process_waiting(self, agent: str) -> None:
        """Process an agent's frames that wait for another stream: there will be no more of it."""
        self._filters[agent].give_up()
        self._take_results(agent)

    def _warnings(self) -> list[str]:
        """Lines that tell of submaps whose place is not known, and of those that contradict each other."""
        if self.session.mode is Mode.LOCALISE:
            lost = sum(not outcome.path for outcome in self._outcomes)
            text = f"{lost} of {len(self._outcomes)} submaps were not found in the map: their poses are left out"
            return [text] * bool(lost)
        shown = self.session.snapshot
        said = [*_loose(shown, self.session.known), *filter(None, [shown.overconfidence])]
        if self._has_positions:
            said.append(positions_text(self.session.counts, self.session.positions_waiting))
        return said

    @property
    def has_frames(self) -> bool:
        """True if any filter has seen a frame."""
        return any(diary.poses for diary in self._diaries.values())

    def record(self, wall_s: float, dropped: Mapping[str, int], failure: str) -> RunRecord:
        """Record of the run, after :meth:`finish`."""
        known, is_located = self.session.known, self.session.mode is Mode.LOCALISE
        shown, landmarks, mapped, fixed_frame = self.session.read(
            lambda now: (now.structure(), now.landmarks(), now.trajectory(known), now.fixed_frame())
        ).result()
        tags = map_tags(shown, landmarks)
        return RunRecord(
            agents={agent: diary.record() for agent, diary in self._diaries.items()},
            map=shown,
            landmarks=landmarks,
            trajectories=self._located() if is_located else mapped,
            submaps=len(self._outcomes),
            loop_closures=sum(outcome.closures for outcome in self._outcomes),
            wall_s=wall_s,
            dropped=dropped,
            stage_ms=self._times.ms,
            rejections=self.rejections(),
            events=tuple(self._events),
            failure=failure,
            solver=next((o.report.solver for o in reversed(self._outcomes) if o.report and o.report.solver), ""),
            backlog=self._backlog(),
            tags=tags,
            fixed_frame=fixed_frame,
        )

    def _located(self) -> dict[str, list[PoseEstimate]]:
        """Poses in a map that stays as it is, by agent: from the first submap of each that was recognised."""
        poses: dict[str, dict[int, PoseEstimate]] = {}
        for outcome in self._outcomes:
            if outcome.path:
                poses.setdefault(outcome.agent, {}).update((pose.stamp_ns, pose) for pose in outcome.path)
        return {agent: [own[stamp] for stamp in sorted(own)] for agent, own in sorted(poses.items())}

    def _backlog(self) -> dict[str, int]:
        session = self.session
        counts = len(self._futures), len(self._outcomes), session.waiting, session.waiting_at_most
        return dict(zip(BACKLOG, counts, strict=True))

    def rejections(self) -> dict[str, int]:
        """Counts of what all filters and the map rejected, by reason."""
        total: Counter[str] = Counter()
        for counts in (*(stage.counters.counts for stage in self._filters.values()), self.session.counts):
            total.update(counts)
        return dict(sorted(total.items()))

    def _take_results(self, agent: str) -> None:
        for frame in self._times.each("ekf", self._filters[agent].ready()):
            self._diaries[agent].add(frame)
            if len(self._diaries[agent].poses) == _LOADED:
                leave_libraries()
            self._hand_over(frame.estimate.submaps)

    def _hand_over(self, submaps: Iterable[Submap]) -> None:
        self._futures += [self.session.add(rounded(submap) if self._compact else submap) for submap in submaps]


def _rigs(sensors: Mapping[str, AgentSensors]) -> dict[str, list[AgentSensors]]:
    """The sensors of each rig, first camera first, by the rig's namespace."""
    rigs: dict[str, list[AgentSensors]] = {}
    for own in sensors.values():
        rigs.setdefault(own.rig if own.camera else own.agent, []).append(own)
    return rigs


def add_to_filter(stage: FilterStage, value: Value, camera: str = "") -> None:
    """Hand a filter what its sensors, or one of several cameras, have led to, as its node receives it."""
    if isinstance(value, ImuSample):
        stage.add_imu(value)
    elif isinstance(value, OdometryReading):
        stage.add_odometry(value)
    elif isinstance(value, PressureReading):
        stage.add_pressure(value)
    elif isinstance(value, ScanEstimate):
        stage.add_motion(value.pose.stamp_ns, motion_as_received(value.motion))
    elif isinstance(value, Features):
        stage.add_features(value, camera)


def _loose(shown: MapSnapshot, known: int) -> list[str]:
    """Lines that tell of new submaps whose place nothing knows: in the old map, or beside the first agent's."""
    new = [agent for agent, _, _ in shown.keys[known:]]
    loose = Counter(agent for agent, is_tied in zip(new, shown.is_tied[known:], strict=True) if not is_tied)
    if known and loose:
        return [f"{loose.total()} of {len(new)} submaps are not tied to the old map: no place of it was recognised"]
    every = Counter(new)
    return [
        f"{count} of {every[agent]} submaps of {agent or 'the rig'} are not tied to the rest of the map: no place "
        "was recognised, and where they are beside it is not known"
        for agent, count in sorted(loose.items())
    ]


class _Diary:
    """Essence of an agent's frames: whole results, with their views of the open submap, would fill the memory."""

    def __init__(self) -> None:
        self.poses: list[PoseEstimate] = []
        self.scans: list[PoseEstimate] = []
        self.readout_seen_s = 0.0, 0.0
        self.rides: list[tuple[int, int]] = []
        self._features: list[int] = []
        self._changes = StateChanges()

    def add(self, frame: FrameResult) -> None:
        estimate = frame.estimate
        self.poses.append(estimate.pose)
        self._features.append(frame.features)
        self._changes.add(estimate.stamp_ns, estimate.state.value, estimate.reason)

    def record(self) -> AgentRecord:
        changes = self._changes
        return AgentRecord(
            self.poses,
            self.scans,
            self._features,
            changes.events,
            changes.lost_share,
            self.readout_seen_s,
            rides=self.rides,
        )
