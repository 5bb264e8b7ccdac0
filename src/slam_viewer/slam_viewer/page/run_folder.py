# SPDX-License-Identifier: Apache-2.0
"""A finished run for the viewer: the files of its folder, read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.plan_io import read_plan
from dense_mapping.reconstruction.surface import Surface
from dense_mapping.reconstruction.surface_io import read_mesh
from sjsam_node.global_map import GlobalMap
from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.storage.files import read_json
from slam_core.trajectory import Trajectory, read_covariance_csv, read_trajectory


@dataclass(frozen=True, eq=False)
class RunFolder:
    """A finished run. ``note``: what could not be read, in words, or empty."""

    path: Path
    summary: dict[str, Any]
    trajectories: dict[str, Trajectory]
    map: MapSnapshot
    surface: Surface
    plans: tuple[FloorPlan, ...]
    note: str = ""

    @classmethod
    def read(cls, path: Path) -> RunFolder:
        """The run in a folder.

        Raises
        ------
        ValueError
            If the folder holds no finished run, or a damaged one.
        """
        if not (path / "summary.json").is_file():
            raise ValueError(f"{path} holds no finished run (no summary.json): slam run BAG -o {path} makes one")
        try:
            summary = read_json(path / "summary.json")
        except ValueError as error:
            raise ValueError(f"{path / 'summary.json'} is damaged: {error}") from error
        mesh = path / "mesh.ply"
        snapshot, note = _map(path / "map")
        return cls(
            path=path,
            summary=summary,
            trajectories=read_trajectories(path),
            map=snapshot,
            surface=read_mesh(mesh) if mesh.is_file() else Surface.empty(),
            plans=tuple(read_plan(file) for file in sorted(path.glob("floor_plan*.yaml"))),
            note=note,
        )

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of all trajectories."""
        stamps = [t.stamps_ns for t in self.trajectories.values() if len(t)]
        return (min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)) if stamps else (0, 0)

    def submap_lines(self, until_ns: int | None = None) -> FloatArray:
        """Start and end (n, 2, 3) m of the submaps that were finished by a stamp."""
        ended = self._ends_ns <= (np.inf if until_ns is None else until_ns)
        return self.map.skeleton_lines()[ended]

    def closure_lines(self, until_ns: int | None = None) -> FloatArray:
        """Ends (n, 2, 3) m of the closures between submaps that were finished by a stamp."""
        ended = self._ends_ns <= (np.inf if until_ns is None else until_ns)
        return self.map.closure_lines()[ended[self.map.closures].all(axis=1)]

    @property
    def _ends_ns(self) -> IntArray:
        """Stamps at which the submaps were finished, (n,)."""
        return np.array([submap.end_stamp_ns for submap in self.map.submaps], dtype=np.int64)


def _map(path: Path) -> tuple[MapSnapshot, str]:
    """The map, or an empty one and why: a run of another version still has all its other files to show."""
    try:
        return GlobalMap.load(path).snapshot(), ""
    except ValueError as error:
        return GlobalMap().snapshot(), f"landmarks and submaps are not shown: {error}"


def read_trajectories(path: Path) -> dict[str, Trajectory]:
    """Trajectories of a run in the map frame, by agent, with their covariances where they are there."""
    several = sorted(p for p in path.glob("trajectory_*.tum") if not _is_anchored(p))
    files = {p.stem.removeprefix("trajectory_"): p for p in several} or {"": path / "trajectory.tum"}
    out = {}
    for agent, file in files.items():
        trajectory = read_trajectory(file) if file.is_file() and file.stat().st_size else Trajectory.from_estimates([])
        covariances = file.with_name(f"{file.stem}_covariance.csv")
        if covariances.is_file() and len(trajectory):
            stamps, P = read_covariance_csv(covariances)
            if np.array_equal(stamps, trajectory.stamps_ns):
                trajectory = Trajectory(stamps, trajectory.poses, P)
        out[agent] = trajectory
    return out


def _is_anchored(path: Path) -> bool:
    """True for ``trajectory_building*.tum``, which ``slam anchor`` writes beside the trajectory in the map frame."""
    rest = path.name.removeprefix("trajectory_building")
    return rest != path.name and path.with_name(f"trajectory{rest}").is_file()
