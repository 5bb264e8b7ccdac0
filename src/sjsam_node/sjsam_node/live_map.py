# SPDX-License-Identifier: Apache-2.0
"""A map that grows on a thread of its own, while whoever asks is answered from its last estimate.

    live = LiveMap(config, Autosave(path, 10.0))
    live.add(submap).add_done_callback(...)     # a future of Joined
    live.mark(point), live.snapshot                # at once, however many submaps wait

The writer's thread alone touches the map. Methods whose description begins with "Writer:" run there.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from sjsam_node.autosave import Autosave
from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.joiner_stage import JoinerStage
from sjsam_node.localization import Localization, Localizer
from sjsam_node.marks import Mark
from slam_core.geometry import FloatArray
from slam_core.types import PoseEstimate, Submap

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Joined:
    """Result of joining a submap: report, end in the map and in its agent's odometry, all counts so far.

    ``end`` is None for a refused submap; ``duration_s`` is what joining took.
    """

    report: JoinReport
    end: PoseEstimate | None
    in_odom: PoseEstimate
    counts: dict[str, int]
    duration_s: float


class LiveMap:
    """One map of several agents that send submaps at any time.

    Attributes
    ----------
    global_map
        The map, which the writer changes.
    snapshot
        The map as of the last submap joined.
    copy_is_old
        Whether the map has changed since the autosave had it.
    """

    def __init__(self, config: GlobalMapConfig, autosave: Autosave, *, keeps_map: bool = False) -> None:
        self._config, self._autosave, self._keeps_map = config, autosave, keeps_map
        self._was_loaded = False
        self._lock, self._resets = threading.Lock(), 0
        self._localizers: dict[str, Localizer] = {}
        self._take(GlobalMap(config))
        self.copy_is_old = False
        self._joiner = JoinerStage()
        self._copy: Future[None] = self._joiner.when_idle()

    def _take(self, other: GlobalMap) -> None:
        """Go on with another map."""
        with self._lock:
            self.global_map, self.snapshot, self._localizers = other, other.snapshot(), {}
            self.copy_is_old = True

    # -- submaps -------------------------------------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """Number of submaps that are not joined yet, the one at hand included."""
        return self._joiner.waiting

    @property
    def waiting_at_most(self) -> int:
        """Largest number of submaps that waited at once."""
        return self._joiner.waiting_at_most

    def add(self, submap: Submap) -> Future[Joined | None]:
        """Join a submap when those before it are; None if the map was reset meanwhile."""
        return self._joiner.join(self._unless_reset(partial(self._join, submap)))

    def locate(self, agent: str, submap: Submap) -> Future[Localization | None]:
        """Locate an agent by a submap in the map as it is; None if the agents were reset meanwhile."""
        return self._joiner.join(self._unless_reset(lambda: self._localizer(agent).process(submap)))

    def set_pose(self, agent: str, pose: PoseEstimate) -> None:
        """Tell where an agent is believed to be."""
        self._joiner.ask(lambda: self._localizer(agent).set_pose(pose))

    def _unless_reset(self, task: Callable[[], T]) -> Callable[[], T | None]:
        resets = self._resets
        return lambda: task() if resets == self._resets else None

    def _join(self, submap: Submap) -> Joined | None:
        """Writer: the map with one more submap."""
        growing, began = self.global_map, time.perf_counter()
        report = growing.add(submap)
        end = growing.end_pose(submap.agent) if report.accepted else None
        with self._lock:
            if growing is not self.global_map:
                return None
            if report.accepted:
                self.snapshot, self.copy_is_old = growing.snapshot(), True
        in_odom, counts = growing.odometry_pose(submap.agent), dict(growing.counters.counts)
        return Joined(report, end, in_odom, counts, time.perf_counter() - began)

    def _localizer(self, agent: str) -> Localizer:
        return self._localizers.setdefault(agent, Localizer(self.global_map))

    # -- the map as a whole --------------------------------------------------------------------------------------------

    def read(self, view: Callable[[GlobalMap], T]) -> Future[T]:
        """A view of the map as soon as the submap at hand is joined."""
        return self._joiner.ask(lambda: view(self.global_map))

    def mark(self, point: FloatArray) -> Mark:
        """Mark a point (3,) of the map frame, m, at once; ValueError in an empty map."""
        with self._lock:
            mark = self.global_map.marks.add(self.snapshot.poses, point)
            self.copy_is_old = True
        return mark

    def reset(self, *, forget: bool) -> None:
        """Forget where the agents are and what waits, and the map too if it is to be forgotten."""
        self._resets += 1
        if forget:
            self._take(GlobalMap(self._config))
            self.copy_is_old = self._was_loaded = False
            self._joiner.ask(self._autosave.put_away)
        else:
            self._localizers = {}

    def save(self, path: Path) -> Future[None]:
        """Save the map with the submaps joined so far; ValueError for an empty one where there is another."""
        return self._joiner.ask(partial(self._save, path))

    def _save(self, path: Path) -> None:
        """Writer: save the map."""
        if not len(self.global_map.snapshot()) and path.exists():
            raise ValueError(f"the map is empty: {path} is left as it is")
        self.global_map.save(path)
        self._copy_now()  # a node that is killed from now on goes on from no less

    def load(self, path: Path, view: Callable[[GlobalMap], T]) -> Future[T]:
        """Take the map of a folder in the place of this one, once it is loaded and viewed; ValueError if it cannot be.

        Submaps that wait are joined to it.
        """
        return self._joiner.ask(partial(self._load, path, view))

    def _load(self, path: Path, view: Callable[[GlobalMap], T]) -> T:
        """Writer: load a map and view it: whatever is wrong with it shows before anything changes."""
        loaded = GlobalMap.load(path, self._config)
        seen = view(loaded)
        self._take(loaded)
        self._was_loaded = True
        return seen

    # -- copies --------------------------------------------------------------------------------------------------------

    def killed(self) -> Path | None:
        """The copy that a killed node left, or None."""
        return self._autosave.found()

    def save_copy(self) -> Future[None] | None:
        """Hand a copy of the map to the autosave if one is due; the future raises what went wrong with the last one."""
        if not self.copy_is_old or not self._copy.done():
            return None
        self._copy = self._joiner.ask(self._hand_copy)
        return self._copy

    def _hand_copy(self) -> None:
        """Writer: begin a copy, if the one before is old enough, and written."""
        if self._autosave.is_due(time.monotonic()):
            self.copy_is_old = False
            self._autosave.save(self.global_map.stored(), time.monotonic())

    def finish(self) -> Future[None]:
        """Join all submaps that wait and settle the map; a new one ends up the same whoever came first."""
        return self._joiner.when_idle(self._finish)

    def _finish(self) -> None:
        """Writer: settle the map; one that was loaded keeps its frame."""
        if self._keeps_map:
            return
        settled = self.global_map
        if self._was_loaded:
            settled.settle()
        else:
            settled = settled.rebuilt_in_time_order()
        with self._lock:
            if settled is not self.global_map:  # somebody may have marked something meanwhile
                settled.marks = self.global_map.marks_in(settled)
            self.global_map, self.snapshot, self.copy_is_old = settled, settled.snapshot(), True

    def close(self) -> None:
        """Join what waits, write what no copy has, and put the copy away: nobody needs to go on from it."""
        joined = self._joiner.when_idle()
        while wait([joined], 1.0).not_done:
            self.save_copy()
        self._joiner.close()
        self._copy_now()
        self._autosave.put_away()
        self._autosave.close()

    def _copy_now(self) -> None:
        """Writer, or after its end: bring the copy up to date."""
        if self._autosave.is_on and self.copy_is_old:
            self.copy_is_old = False
            self._autosave.wait()
            self._autosave.save(self.global_map.stored(), time.monotonic())
            self._autosave.wait()
