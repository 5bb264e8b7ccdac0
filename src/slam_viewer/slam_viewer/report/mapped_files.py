# SPDX-License-Identifier: Apache-2.0
"""The files of a run that need neither a dense model nor anything that draws."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from sjsam_node.tags.map_tags import tags_file
from slam_core.geometry import inverse_jacobian, invert_transform
from slam_core.point_cloud import write_ply
from slam_core.storage.anchor_file import Anchor
from slam_core.storage.files import atomic_text
from slam_core.trajectory import write_covariance_csv, write_tum
from slam_viewer.results import AgentResult, LandmarkMap, RunResult

SaveMap = Callable[[Path], object]
"""Writes the loadable map to a folder."""


def write_mapped(out: Path, result: RunResult, save_map: SaveMap | None = None) -> None:
    """Write what needs no dense model into the folder ``out`` (made if absent): ``map/``, trajectories, landmarks."""
    out.mkdir(parents=True, exist_ok=True)
    if save_map is not None:
        save_map(out / "map")
    _write_trajectories(out, result.agents)
    _write_landmarks(out / "landmarks.ply", result.landmarks)
    if (frame := result.fixed_frame) is not None:
        T = invert_transform(frame.T)
        J = inverse_jacobian(frame.T)
        Anchor(T, J @ frame.covariance @ J.T, written_by="slam run").write(out / "anchor.yaml")
    if any(tag.is_tied and tag.submaps for tag in result.tags):
        atomic_text(out / "tags.yaml", yaml.safe_dump(tags_file(result.tags), sort_keys=False, default_flow_style=None))


def _write_landmarks(path: Path, landmarks: LandmarkMap) -> None:
    """Positions with the upper triangle of each covariance, m2, and the number of sightings."""
    entries = {f"cov_{'xyz'[i]}{'xyz'[j]}": landmarks.covariances[:, i, j] for i in range(3) for j in range(i, 3)}
    write_ply(path, landmarks.positions.astype(np.float32), scalars={**entries, "sightings": landmarks.sightings})


def _write_trajectories(out: Path, agents: tuple[AgentResult, ...]) -> None:
    named = [("", agent) for agent in agents[:1]]
    if len(agents) > 1:
        named += [(f"_{agent.name}", agent) for agent in agents]
    for suffix, agent in named:
        write_tum(out / f"trajectory{suffix}.tum", agent.trajectory)
        if agent.trajectory.covariances is not None:
            write_covariance_csv(out / f"trajectory{suffix}_covariance.csv", agent.trajectory)
        if len(agent.truth):
            write_tum(out / f"ground_truth{suffix}.tum", agent.truth)
