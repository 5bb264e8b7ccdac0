# SPDX-License-Identifier: Apache-2.0
"""Use of the submaps of a run: for a new map, more of a finished one, or places in one that stays as it is."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from sjsam_node import storage
from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.localization import Localizer
from slam_core.geometry import compose_covariance
from slam_core.types import PoseEstimate, Submap

_LOG = logging.getLogger(__name__)


class MapGrowth(Protocol):
    """Takes the submaps of all agents in order.

    Attributes
    ----------
    global_map
        The map, after :meth:`finish` as it is to be shown and kept.
    closures
        Places recognised so far.
    solver
        What solved for the map last; "" where nothing was solved.
    """

    global_map: GlobalMap
    closures: int
    solver: str

    def session(self, agent: str) -> int:
        """Number of an agent's first session, which the map does not have yet."""

    def add(self, submap: Submap) -> None:
        """Take one more submap."""

    def finish(self) -> list[str]:
        """Do what is left to do when all are there, and tell what a person should know."""

    def trajectories(self) -> Mapping[str, Sequence[PoseEstimate]]:
        """Poses T_map_base of this run by agent, with covariances, map frame."""

    def save(self, folder: Path) -> None:
        """Write the map to a folder; nothing is added to it, and no covariance asked for, after that."""


def map_growth(config: GlobalMapConfig, old: Path | None = None, *, localize_only: bool = False) -> MapGrowth:
    """Joins into a new map, or into that of a run's folder ``old``; with ``localize_only`` locates in the latter.

    Raises
    ------
    ValueError
        If there is no map in ``old``, or none is given to locate in.
    """
    folder = map_folder(old, localize_only=localize_only)
    if folder is None:
        return Joining(GlobalMap(config))
    loaded = GlobalMap.load(folder, config)
    if not len(loaded.snapshot()):
        raise ValueError(f"the map in {old} is empty: nothing can be found again in it")
    return Locating(loaded) if localize_only else Joining(loaded)


def map_folder(old: Path | None, *, localize_only: bool) -> Path | None:
    """Folder of the map that ``old`` names: OUT/map of a run's folder OUT, else itself; None without one.

    Raises
    ------
    ValueError
        If there is none to locate in.
    """
    if old is None and localize_only:
        raise ValueError("--localize-only needs a map to locate in: name the folder of a finished run with --map")
    return old / "map" if old is not None and (old / "map").is_dir() else old


class Joining:
    """Joins submaps into a map, an empty one or one of earlier runs, whose frame stays the map's."""

    def __init__(self, global_map: GlobalMap) -> None:
        self.global_map = global_map
        self.closures = 0
        self.solver = ""
        self._known = len(global_map.snapshot())
        self._sessions = _sessions(global_map)

    def session(self, agent: str) -> int:
        """Number after the last one of the agent in the map."""
        return self._sessions.get(agent, -1) + 1

    def add(self, submap: Submap) -> None:
        """Join one submap."""
        report = self.global_map.add(submap)
        _LOG.info(
            "submap %d of %s: %s, %d landmarks known, %d new, closures %s",
            submap.index,
            submap.agent or "the rig",
            report.reason or "joined",
            report.matched,
            report.new_landmarks,
            list(report.closures),
        )
        self.closures += len(report.closures)
        self.solver = report.solver or self.solver

    def finish(self) -> list[str]:
        """Settle the map; a new one ends up the same whoever came first."""
        if not self._known:
            self.global_map = self.global_map.rebuilt_in_time_order()
        self.global_map.settle()
        return [*self._apart(), *filter(None, [self.global_map.overconfidence])]

    def _apart(self) -> list[str]:
        """Tell of new submaps whose place in the map nothing knows: in the old one, or beside the first agent's."""
        snapshot = self.global_map.snapshot()
        new = [key[0] for key in snapshot.keys[self._known :]]
        loose = Counter(a for a, is_tied in zip(new, snapshot.is_tied[self._known :], strict=True) if not is_tied)
        if self._known and loose:
            count = loose.total()
            return [f"{count} of {len(new)} submaps are not tied to the old map: no place of it was recognised"]
        every = Counter(new)
        return [
            f"{count} of {every[agent]} submaps of {agent or 'the rig'} are not tied to the rest of the map: no place "
            "was recognised, and where they are beside it is not known"
            for agent, count in sorted(loose.items())
        ]

    def trajectories(self) -> Mapping[str, Sequence[PoseEstimate]]:
        """Smoothed poses of this run, without those that were in the map before."""
        return self.global_map.snapshot().trajectory(self._known)

    def save(self, folder: Path) -> None:
        """Write the map, the old one and what is new."""
        self.global_map.save(folder, is_last=True)


class Locating:
    """Locates submaps in a map that stays as it is.

    An agent's poses begin with the first submap that is recognised; from there its odometry carries them on.
    """

    def __init__(self, global_map: GlobalMap) -> None:
        self.global_map = global_map
        self.closures = 0
        self.solver = ""
        self._sessions = _sessions(global_map)
        self._localizers: dict[str, Localizer] = {}
        self._poses: dict[str, dict[int, PoseEstimate]] = {}
        self._lost = self._taken = 0

    def session(self, agent: str) -> int:
        """Number after the last one of the agent in the map."""
        return self._sessions.get(agent, -1) + 1

    def add(self, submap: Submap) -> None:
        """Locate one submap and all poses inside it."""
        localizer = self._localizers.setdefault(submap.agent, Localizer(self.global_map))
        found = localizer.process(submap)
        known = "not recognised" if found.start is None else f"{found.matched} landmarks recognised"
        _LOG.info("submap %d of %s: %s", submap.index, submap.agent or "the rig", known)
        self._taken += 1
        self.closures += found.matched > 0
        if found.start is None:
            self._lost += 1
            return
        own = self._poses.setdefault(submap.agent, {})
        for p in submap.path:
            covariance = compose_covariance(found.start.T, found.start.covariance, p.T, p.covariance)
            own[p.stamp_ns] = PoseEstimate(p.stamp_ns, found.start.T @ p.T, covariance)

    def finish(self) -> list[str]:
        """Tell of submaps whose place is not known."""
        if not self._lost:
            return []
        return [f"{self._lost} of {self._taken} submaps were not found in the map: their poses are left out"]

    def trajectories(self) -> Mapping[str, Sequence[PoseEstimate]]:
        """Poses of this run from the first submap of each agent that was recognised."""
        return {agent: [poses[stamp] for stamp in sorted(poses)] for agent, poses in sorted(self._poses.items())}

    def save(self, folder: Path) -> None:
        """Write the map as it was read."""
        storage.write(folder, self.global_map.stored())


def _sessions(global_map: GlobalMap) -> dict[str, int]:
    """The last session of every agent in a map."""
    last: dict[str, int] = {}
    for agent, session, _ in global_map.snapshot().keys:
        last[agent] = max(session, last.get(agent, -1))
    return last
