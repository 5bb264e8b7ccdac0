"""The filters of all agents and the one map that their submaps are joined into.

Joining runs on a thread of its own, submap after submap: no filter waits for the map, which it does not need. Where the
nodes would send compact submaps, their rounding is in the map here too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from ekf_slam_node.results import EkfResult, TrackingState
from ekf_slam_node.slam import EkfSlam
from sjsam_node.global_map import GlobalMap, JoinReport
from slam_bringup.pipeline.configuration import SystemConfig
from slam_bringup.pipeline.eyes import FilterInput
from slam_bringup.pipeline.stage_times import StageTimes
from slam_core.geometry import FloatArray
from slam_core.messages import rounded
from slam_core.types import PoseEstimate, Submap


@dataclass(eq=False)
class AgentRecord:
    """What was said of one agent, frame by frame."""

    filtered: list[PoseEstimate] = field(default_factory=list)
    scans: list[PoseEstimate] = field(default_factory=list)
    feature_counts: list[int] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    state: TrackingState = TrackingState.OK

    def add(self, result: EkfResult, features: int) -> None:
        """Take one frame's result; a change of state is an event."""
        self.filtered.append(result.pose)
        self.feature_counts.append(features)
        if result.state is not self.state:
            reason = f": {result.reason}" if result.reason else ""
            self.events.append(f"{result.stamp_ns / 1e9:.3f} s, {result.state.value}{reason}")
        self.state = result.state


class Mapper:
    """Takes the inputs of all filters in order; ``global_map`` grows with every submap that one of them finishes.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera of each agent, by name.
    """

    def __init__(self, config: SystemConfig, T_rig_optical: dict[str, FloatArray], times: StageTimes) -> None:
        self._times = times
        self._compact = config.ekf_slam.submap.compact
        self._filters = {agent: EkfSlam(replace(config.ekf_slam, agent=agent), T) for agent, T in T_rig_optical.items()}
        self.records = {agent: AgentRecord() for agent in T_rig_optical}
        self.reports: list[JoinReport] = []
        """One per submap joined, complete after :meth:`finish`."""
        self.global_map = GlobalMap(config.sjsam)
        self._joiner = ThreadPoolExecutor(1, thread_name_prefix="joining")
        self._joins: list[Future[JoinReport]] = []

    def process(self, item: FilterInput) -> None:
        """One step of one agent's filter, and of the map where that finished a submap."""
        ekf, record = self._filters[item.agent], self.records[item.agent]
        if item.imu is not None:
            ekf.process_imu(item.imu)
        if item.scan_pose is not None:
            record.scans.append(item.scan_pose)
        if item.motion is not None:
            ekf.process_motion(item.motion)
        if item.features is not None:
            with self._times.measure("ekf"):
                result = ekf.process(item.features)
            record.add(result, len(item.features))
            self._join(result.submaps)

    def finish(self) -> None:
        """Close the open submaps and wait until all are joined; the map ends up the same whoever came first.

        A submap whose joining failed is left out of the map; the events say so.
        """
        for ekf in self._filters.values():
            self._join(ekf.finish())
        for join in self._joins:
            error = join.exception()
            if error is None:
                self.reports.append(join.result())
            else:
                next(iter(self.records.values())).events.append(f"a submap could not be joined: {error!r}")
        self.global_map = self.global_map.centrally()

    def stop(self) -> None:
        """End the thread that joins, at the latest after the submap it is at."""
        self._joiner.shutdown(cancel_futures=True)

    def rejections(self) -> dict[str, int]:
        """What all filters and the map rejected, by reason."""
        total: Counter[str] = Counter()
        for counters in (*(ekf.counters for ekf in self._filters.values()), self.global_map.counters):
            total.update(counters.counts)
        return dict(sorted(total.items()))

    def _join(self, submaps: Iterable[Submap]) -> None:
        self._joins += [self._joiner.submit(self._add, submap) for submap in submaps]

    def _add(self, submap: Submap) -> JoinReport:
        with self._times.measure("sjsam"):
            return self.global_map.add(rounded(submap) if self._compact else submap)
