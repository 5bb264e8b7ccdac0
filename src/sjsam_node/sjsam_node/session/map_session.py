# SPDX-License-Identifier: Apache-2.0
"""The one session of a map: submaps of all agents in, a map or their places in it out, on a thread of its own.

    session = MapSession(config)
    session.load(folder).result()                  # only to go on in a map that is there, or to locate in it
    session.add(submap).add_done_callback(...)     # a future of Outcome
    session.mark(point), session.snapshot          # at once, however many submaps wait
    session.finish().result()
    session.save(folder).result()

With ``tasks`` parts of the work run on a cluster, with the same bytes; they end with the session.
The thread alone changes the map; whoever hands something over goes on at once. Methods whose description begins with
"Thread:" run there. Only marks are set by the caller, under a lock.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from queue import PriorityQueue
from typing import Any, Self, TypeVar

from sjsam_node.global_map import GlobalMap, GlobalMapConfig, JoinReport
from sjsam_node.graph.marks import Mark, Marks
from sjsam_node.map_file import storage
from sjsam_node.map_file.refining import undecided
from sjsam_node.positions.position_queue import PositionQueue
from sjsam_node.regions.live import LiveTasks
from sjsam_node.session.autosave import Autosave
from sjsam_node.session.localization import Localizer
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.geometry import FloatArray
from slam_core.types import PoseEstimate, PositionReading, Submap

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
_REQUEST, _SUBMAP, _LAST = range(3)
"""Priorities of what waits, the first one first."""


class Mode(Enum):
    """Use of submaps: for a new map, for more of a loaded one, or for places in one that stays as it is."""

    MAP = "map"
    EXTEND = "extend"
    LOCALISE = "localise"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of handing a submap of an agent over.

    end: the pose at its end in the map, None where it was refused or is not known; closures: places recognised;
    duration_s: what it took. Of one that was joined or refused: report, in_odom, its end in its agent's odometry, and
    undecided, agent, session and index of submaps whose closures wait (:mod:`sjsam_node.map_file.refining`).
    Of one that was to be located: path, the poses inside it in the map, empty where its place is not known.
    """

    agent: str
    end: PoseEstimate | None
    closures: int
    report: JoinReport | None = None
    in_odom: PoseEstimate | None = None
    path: tuple[PoseEstimate, ...] = ()
    duration_s: float = 0.0
    undecided: frozenset[tuple[str, int, int]] = frozenset()


class MapSession:
    """One map of several agents that send submaps at any time.

    Attributes
    ----------
    mode
        What is done with submaps; loading a map into a session that maps makes it extend that one.
    snapshot
        The map as of its last update, without covariances (those: :meth:`read`).
    counts
        What the map has counted until then, by name.
    known
        Number of submaps that the map had when it was loaded.
    waiting_at_most
        Largest number of submaps that waited at once.
    """

    snapshot: MapSnapshot
    counts: dict[str, int]

    def __init__(
        self, config: GlobalMapConfig, mode: Mode = Mode.MAP, autosave: Autosave | None = None,
        tasks: LiveTasks | None = None,
    ) -> None:  # fmt: skip
        self.mode, self._config, self._autosave, self._elsewhere = mode, config, autosave, tasks
        self._executor = ThreadPoolExecutor(1, "map")  # its thread ends with the session
        self._tasks = PriorityQueue[tuple[int, int, Future[Any], Callable[[], Any]]]()
        self._number = itertools.count()
        self._submaps: list[Future[Any]] = []
        self.waiting_at_most = 0
        self._positions = PositionQueue(round(config.position.interval * 1e9))
        self._lock, self._asked_resets, self._done_resets = threading.Lock(), 0, 0
        self._go_on_with(GlobalMap(config, tasks))
        self._copied: MapSnapshot | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread after the submap it is at; what waits is left undone."""
        self._executor.shutdown(cancel_futures=True)
        self._leave_cluster()

    def _leave_cluster(self) -> None:
        if self._elsewhere is not None:
            self._elsewhere.close()

    # -- the thread ----------------------------------------------------------------------------------------------------

    def _put(self, priority: int, task: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        self._tasks.put((priority, next(self._number), future, task))
        self._executor.submit(self._do_first)
        return future

    def _do_first(self) -> None:
        """Thread: do the first of the tasks."""
        _, _, future, task = self._tasks.get()
        try:
            result = task()
        except Exception as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    def _go_on_with(self, global_map: GlobalMap) -> None:
        """Thread: take another map in the place of this one."""
        with self._lock:
            self._map, self.known = global_map, len(global_map.snapshot())
        self._localizers: dict[str, Localizer] = {}
        self._publish()

    def _publish(self) -> None:
        """Thread: show the map as it is, unless it is to be forgotten."""
        with self._lock:
            if not self._is_to_reset:
                self.snapshot = self._map.snapshot().structure()
                self.counts = self._map.counters.counts | self._positions.counters.counts

    # -- submaps -------------------------------------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """Number of submaps that are not joined yet, the one at hand included."""
        self._submaps = [future for future in self._submaps if not future.done()]
        return len(self._submaps)

    @property
    def load_counts(self) -> dict[str, int]:
        """Numbers of submaps that wait, and of tasks that the cluster did, or this process in its place, by name."""
        tasks = self._elsewhere
        elsewhere = {} if tasks is None else {"tasks elsewhere": tasks.elsewhere, "tasks here": tasks.here}
        return {"submaps waiting": self.waiting, "submaps waiting at most": self.waiting_at_most} | elsewhere

    @property
    def next_session(self) -> int:
        """Number of a session that no agent in the map has had; -1 in a new one: the second of the first stamp."""
        return 1 + max((session for _, session, _ in self.snapshot.keys), default=-2)

    @property
    def positions_waiting(self) -> int:
        """Number of positions whose submaps are joined, but not tied to the fixed frame; after :meth:`finish`."""
        return self._map.positions.waiting_count

    def add_position(self, agent: str, reading: PositionReading) -> None:
        """Take a position of an agent in a fixed frame; it counts if it comes before the submap that it is inside."""
        if self._config.position.use != "off":
            self._positions.add(agent, reading)

    def add(self, submap: Submap) -> Future[Outcome | None]:
        """Join a submap, or locate its agent by it, after those before it; None if all was reset meanwhile."""
        future = self._put(_SUBMAP, partial(self._add, submap, self._positions.take(submap), self._asked_resets))
        self._submaps.append(future)
        self.waiting_at_most = max(self.waiting_at_most, self.waiting)
        return future

    def _add(self, submap: Submap, readings: Sequence[PositionReading], resets: int) -> Outcome | None:
        """Thread: do with a submap what the mode says."""
        if resets != self._done_resets:
            return None
        began = time.perf_counter()
        outcome = self._locate(submap) if self.mode is Mode.LOCALISE else self._join(submap, readings)
        return None if self._is_to_reset else replace(outcome, duration_s=time.perf_counter() - began)

    def _join(self, submap: Submap, readings: Sequence[PositionReading]) -> Outcome:
        """Thread: the map with one more submap, and the positions inside it."""
        report = self._map.add(submap, readings)
        _LOG.info(
            "submap %d of %s: %s, %d landmarks known, %d new, closures %s", submap.index, submap.agent or "the rig",
            report.reason or "joined", report.matched, report.new_landmarks, list(report.closures),
        )  # fmt: skip
        end = self._map.end_pose(submap.agent) if report.accepted else None
        if report.accepted:
            self._publish()
        waits = undecided(self._map.estimate.graph, self._map.detector.pending)
        in_odom = self._map.odometry_pose(submap.agent)
        return Outcome(submap.agent, end, len(report.closures), report, in_odom, undecided=waits)

    def _locate(self, submap: Submap) -> Outcome:
        """Thread: the place of a submap in the map."""
        found = self._localizer(submap.agent).process(submap)
        known = f"{found.matched} landmarks recognised" if found.path else "not recognised"
        _LOG.info("submap %d of %s: %s", submap.index, submap.agent or "the rig", known)
        return Outcome(submap.agent, found.pose, int(found.matched > 0), path=found.path)

    def _localizer(self, agent: str) -> Localizer:
        return self._localizers.setdefault(agent, Localizer(self._map))

    def set_pose(self, agent: str, pose: PoseEstimate) -> None:
        """Tell where in the map an agent is believed to be."""
        self._put(_REQUEST, lambda: self._localizer(agent).set_pose(pose))

    def finish(self) -> Future[None]:
        """Join all submaps that wait and settle the map; a new one ends up the same whoever came first."""
        return self._put(_LAST, self._settle)

    def _settle(self) -> None:
        """Thread: settle the map; one that was loaded keeps its frame."""
        if self.mode is Mode.EXTEND:
            self._map.settle()
        elif self.mode is Mode.MAP:
            settled = self._map.rebuilt_in_time_order()
            with self._lock:
                if settled is not self._map:  # somebody may have marked something meanwhile
                    settled.marks = self._map.marks_in(settled)
                self._map = settled
        self._publish()

    # -- the map as a whole --------------------------------------------------------------------------------------------

    def read(self, view: Callable[[MapSnapshot], T]) -> Future[T]:
        """A view of the map with its covariances, as soon as the submap at hand is joined."""
        return self._put(_REQUEST, lambda: view(self._map.snapshot()))

    def mark(self, point: FloatArray) -> Mark:
        """Mark a point (3,) of the map frame, m, at once; ValueError in an empty map."""
        with self._lock:
            mark = self._map.marks.add(self.snapshot.poses, point, where=self.snapshot.is_on_a_way)
            self.snapshot = replace(self.snapshot, marks=Marks(list(self._map.marks.marks)))
        return mark

    def reset(self) -> None:
        """Forget where the agents are and what waits, and the map too unless it is to stay as it is."""
        with self._lock:
            self._asked_resets += 1
            self._positions.clear()
            if self.mode is not Mode.LOCALISE:
                self.snapshot = GlobalMap(self._config).snapshot()
        self._put(_REQUEST, self._begin_anew)

    @property
    def _is_to_reset(self) -> bool:
        return self._done_resets != self._asked_resets

    def _begin_anew(self) -> None:
        """Thread: forget what is to be forgotten."""
        self._done_resets += 1
        if self.mode is Mode.LOCALISE:
            self._localizers = {}
            return
        self.mode = Mode.MAP
        self._go_on_with(GlobalMap(self._config, self._elsewhere))
        if self._autosave is not None:
            self._autosave.retire()

    def save(self, path: Path, *, is_last: bool = False) -> Future[None]:
        """Save the map with the submaps joined so far; ValueError for an empty one where there is another.

        ``is_last``: nobody adds to the map, or reads covariances of it, any more.
        """
        return self._put(_REQUEST, partial(self._save, path, is_last))

    def _save(self, path: Path, is_last: bool) -> None:
        """Thread: save the map; one that is to stay as it is, as it was read."""
        if not len(self._map.snapshot()) and path.exists():
            raise ValueError(f"the map is empty: {path} is left as it is")
        if self.mode is Mode.LOCALISE:
            storage.write(path, self._map.stored())
        else:
            self._map.save(path, is_last=is_last)
            self._publish()
        self._copy_now()  # a node that is killed from now on goes on from no less

    def load(self, path: Path, view: Callable[[MapSnapshot], T]) -> Future[T]:
        """Take the map of a folder in the place of this one, once it is loaded and viewed; ValueError if it cannot be.

        Submaps that wait are joined to it.
        """
        return self._put(_REQUEST, partial(self._load, path, view))

    def _load(self, path: Path, view: Callable[[MapSnapshot], T]) -> T:
        """Thread: load a map and view it: whatever is wrong with it shows before anything changes."""
        loaded = GlobalMap.load(path, self._config, self._elsewhere)
        snapshot = loaded.snapshot()
        if not len(snapshot):
            raise ValueError(f"the map in {path} is empty: nothing can be found again in it")
        seen = view(snapshot)
        self.mode = Mode.EXTEND if self.mode is Mode.MAP else self.mode
        self._go_on_with(loaded)
        return seen

    # -- copies --------------------------------------------------------------------------------------------------------

    def crash_recovery_path(self) -> Path | None:
        """The copy that a killed node left, or None."""
        return None if self._autosave is None else self._autosave.found()

    def save_copy(self) -> Future[None] | None:
        """Hand a copy of the map to the autosave if one is due; the future raises what went wrong with the last one."""
        if self._autosave is None or not self._copy_is_old:
            return None
        return self._put(_REQUEST, partial(self._hand_copy, self._autosave))

    @property
    def _copy_is_old(self) -> bool:
        return len(self.snapshot) > 0 and self.snapshot is not self._copied

    def _hand_copy(self, autosave: Autosave) -> None:
        """Thread: begin a copy, if the one before is old enough, and written."""
        if autosave.is_due(time.monotonic()):
            self._copied = self.snapshot
            autosave.save(self._map.stored(), time.monotonic())

    def close(self) -> None:
        """Join what waits, write what no copy has, and put the copy away: nobody needs to go on from it."""
        joined = self._put(_LAST, lambda: None)
        while wait([joined], 1.0).not_done:
            self.save_copy()
        self._executor.shutdown()
        self._copy_now()
        if self._autosave is not None:
            self._autosave.retire()
            self._autosave.close()
        self._leave_cluster()

    def _copy_now(self) -> None:
        """Thread, or after its end: bring the copy up to date."""
        if self._autosave is not None and self._copy_is_old:
            self._autosave.wait()
            self._copied = self.snapshot
            self._autosave.save(self._map.stored(), time.monotonic())
            self._autosave.wait()
