# SPDX-License-Identifier: Apache-2.0
"""The filters of all agents and the one map that their submaps are joined into.

Joining runs on a thread of its own (:mod:`sjsam_node.joiner_stage`). Where the nodes would send compact submaps, their
rounding is in the map here too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from functools import partial

from ekf_slam_node.stage import FilterStage, FrameResult
from ndt_registration.stage import ScanEstimate
from sjsam_node.agents import in_order
from sjsam_node.joiner_stage import JoinerStage
from slam_bringup.bags.readings import AgentSensors, SessionStart
from slam_bringup.pipeline.configuration import SystemConfig, filter_config
from slam_bringup.pipeline.map_growth import MapGrowth
from slam_bringup.pipeline.run_record import BACKLOG, AgentRecord, RunRecord, StateChanges
from slam_bringup.pipeline.sensor_pipeline import AgentItem
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.memory import give_back, leave_libraries
from slam_core.messages import motion_as_received, rounded
from slam_core.types import Features, ImuSample, PoseEstimate, Submap

_LOADED = 1, 4
"""Frames of an agent after which what images, and what the filter needs, is loaded."""


class Mapper:
    """Takes the inputs of all filters in order, and hands every submap that one of them finishes to the map.

    Parameters
    ----------
    sensors
        What each agent carries, by name.
    growth
        What becomes of the submaps.
    """

    def __init__(
        self, config: SystemConfig, sensors: Mapping[str, AgentSensors], times: StageTimes, growth: MapGrowth
    ) -> None:
        self._times = times
        self.growth = growth
        self._compact = config.ekf_slam.submap.compact
        self._filters = {
            agent: FilterStage(filter_config(config.ekf_slam, s), s.frames, s.base_frame, growth.session(agent))
            for agent, s in sensors.items()
        }
        self._diaries = {agent: _Diary() for agent in sensors}
        self._joiner = JoinerStage()
        self._joins: list[Future[None]] = []
        self._submaps = 0
        self._events: list[str] = []

    def process(self, item: AgentItem) -> None:
        """One step of one agent's filter, and of the map where that finished a submap."""
        stage, value = self._filters[item.agent], item.value
        if isinstance(value, ImuSample):
            stage.add_imu(value)
        elif isinstance(value, ScanEstimate):
            self._diaries[item.agent].scans.append(value.pose)
            stage.add_motion(value.pose.stamp_ns, motion_as_received(value.motion))
        elif isinstance(value, Features):
            stage.add_features(value)
        elif isinstance(value, SessionStart):
            self._process_waiting(item.agent)
            self._join(stage.start_session())
        self._take_results(item.agent)

    def finish(self) -> None:
        """Close the open submaps and wait until all are joined; the map ends up the same whoever came first.

        A submap whose joining failed is left out of the map; the events say so.
        """
        last: list[Submap] = []
        for agent, stage in self._filters.items():
            self._process_waiting(agent)
            if stage.finding:
                self._events.append(f"{agent}: {stage.finding}" if agent else stage.finding)
            last += stage.start_session()  # which no frame begins: the filter forgets its state
        give_back()
        self._join(in_order(last))
        for join in self._joins:
            error = join.exception()
            if error is None:
                self._submaps += 1
            else:
                self._events.append(f"a submap could not be joined: {error!r}")
        self._events += self.growth.finish()
        give_back()

    def _process_waiting(self, agent: str) -> None:
        """Process an agent's frames that wait for another stream: there will be no more of it."""
        self._filters[agent].give_up()
        self._take_results(agent)

    def stop(self) -> None:
        """End the thread that joins, at the latest after the submap it is at."""
        self._joiner.stop()

    @property
    def has_frames(self) -> bool:
        """True if any filter has seen a frame."""
        return any(diary.poses for diary in self._diaries.values())

    def record(self, wall_s: float, dropped: Mapping[str, int], failure: str) -> RunRecord:
        """Record of the run, after :meth:`finish`."""
        snapshot = self.growth.global_map.snapshot()
        return RunRecord(
            agents={agent: diary.record() for agent, diary in self._diaries.items()},
            map=snapshot.structure(),
            landmarks=snapshot.landmarks(),
            trajectories=self.growth.trajectories(),
            submaps=self._submaps,
            loop_closures=self.growth.closures,
            wall_s=wall_s,
            dropped=dropped,
            stage_ms=self._times.ms,
            rejections=self.rejections(),
            events=tuple(self._events),
            failure=failure,
            solver=self.growth.solver,
            backlog=self._backlog(),
        )

    def _backlog(self) -> dict[str, int]:
        joiner = self._joiner
        counts = joiner.received, self._submaps, joiner.waiting, joiner.waiting_at_most
        return dict(zip(BACKLOG, counts, strict=True))

    def rejections(self) -> dict[str, int]:
        """Counts of what all filters and the map rejected, by reason."""
        total: Counter[str] = Counter()
        for counters in (*(stage.counters for stage in self._filters.values()), self.growth.global_map.counters):
            total.update(counters.counts)
        return dict(sorted(total.items()))

    def _take_results(self, agent: str) -> None:
        for frame in self._times.each("ekf", self._filters[agent].ready()):
            self._diaries[agent].add(frame)
            if len(self._diaries[agent].poses) in _LOADED:
                leave_libraries()
            self._join(frame.estimate.submaps)

    def _join(self, submaps: Iterable[Submap]) -> None:
        self._joins += [self._joiner.join(partial(self._add, submap)) for submap in submaps]

    def _add(self, submap: Submap) -> None:
        with self._times.measure("sjsam"):
            self.growth.add(rounded(submap) if self._compact else submap)


class _Diary:
    """Essence of an agent's frames: whole results, with their views of the open submap, would fill the memory."""

    def __init__(self) -> None:
        self.poses: list[PoseEstimate] = []
        self.scans: list[PoseEstimate] = []
        self._features: list[int] = []
        self._changes = StateChanges()

    def add(self, frame: FrameResult) -> None:
        estimate = frame.estimate
        self.poses.append(estimate.pose)
        self._features.append(frame.features)
        self._changes.add(estimate.stamp_ns, estimate.state.value, estimate.reason)

    def record(self) -> AgentRecord:
        return AgentRecord(self.poses, self.scans, self._features, self._changes.events, self._changes.lost_share)
