# SPDX-License-Identifier: Apache-2.0
"""Place of a map in the frame of its building: the file ``anchor.yaml`` that ``slam anchor`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slam_core.geometry import FloatArray, is_rigid_transform, pose7_from_transform, transform_from_pose7
from slam_core.storage.files import atomic_text, read_yaml

BUILDING_FRAME = "building"
_WRITERS = ("slam anchor", "slam run")


@dataclass(frozen=True, eq=False)
class Anchor:
    """``T`` = T_building_map (4, 4) with its covariance (6, 6), translation first, about the building's axes.

    ``frame`` and ``map_frame`` are the names of the two; ``plan`` the building's floor plan and how it lies in that
    frame; ``points`` what the transform comes from; ``files`` digests of what was written with it;
    ``written_by`` the command that wrote it.
    """

    T: FloatArray
    covariance: FloatArray
    frame: str = BUILDING_FRAME
    map_frame: str = "map"
    plan: dict[str, Any] = field(default_factory=dict)
    points: list[dict[str, Any]] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    written_by: str = _WRITERS[0]

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        pose = [float(v) for v in pose7_from_transform(self.T)]
        content = {
            "frame": self.frame, "child_frame": self.map_frame,
            "position": pose[:3], "quaternion": pose[3:],
            "covariance": [[float(v) for v in row] for row in self.covariance],
            "plan": self.plan, "points": self.points, "written_by": self.written_by, "files": self.files,
        }  # fmt: skip
        atomic_text(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def read_anchor(path: Path) -> Anchor:
    """The anchor of a file.

    Raises
    ------
    ValueError
        With the file and what is wrong in it.
    """
    try:
        content = read_yaml(path)
    except OSError as error:
        raise ValueError(f"{path}: the anchor cannot be read: {error.strerror or error}") from error
    if not isinstance(content, Mapping):
        raise ValueError(f"{path} is no anchor of a map: slam anchor OUT PLAN writes one")
    try:
        position, quaternion = (np.array(content[key], dtype=np.float64) for key in ("position", "quaternion"))
        covariance = np.array(content["covariance"], dtype=np.float64)
        frame, child = str(content["frame"]), str(content["child_frame"])
        if position.shape != (3,) or quaternion.shape != (4,) or covariance.shape != (6, 6):
            raise ValueError("position has 3 numbers, quaternion 4 and covariance 6 x 6")
        if not (np.isfinite(position).all() and np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0.5):
            raise ValueError("its pose must be finite numbers, and the quaternion of length 1")
        T = transform_from_pose7(np.concatenate([position, quaternion]))
        _require_covariance(covariance)
        if not is_rigid_transform(T):
            raise ValueError("position and quaternion are no rigid transform")
        if not frame or frame == child:
            raise ValueError("frame and child_frame must be two names")
        files = {str(name): str(value) for name, value in dict(content.get("files") or {}).items()}
    except (KeyError, TypeError, ValueError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path} is no anchor of a map: {missing}") from error
    return Anchor(T, covariance, frame, child, dict(content.get("plan") or {}), [], files)


def is_anchor(path: Path) -> bool:
    """True if ``slam anchor`` wrote the file, or a run with positions in a fixed frame."""
    try:
        content = read_yaml(path)
    except (OSError, ValueError):
        return False
    return isinstance(content, Mapping) and content.get("written_by") in _WRITERS


def _require_covariance(P: FloatArray) -> None:
    if not np.isfinite(P).all() or not np.allclose(P, P.T, rtol=1e-6, atol=1e-12):
        raise ValueError("the covariance must be finite and symmetric")
    if np.linalg.eigvalsh(P).min() <= 0.0:
        raise ValueError("the covariance must be positive definite")
