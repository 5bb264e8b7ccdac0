# SPDX-License-Identifier: Apache-2.0
"""The calibration of a rig from folders that ``slam calibrate`` wrote, used instead of that of a bag or a driver.

- ``left.yaml`` and ``right.yaml`` of one folder: the stereo camera.
- ``tof.yaml`` (of ``stereo-tof``) or ``camera.yaml`` (of ``mono``): the ToF or depth camera.
- ``extrinsics.yaml`` of ``stereo-tof``: the static transform from the depth camera to the rectified left camera.
- ``calibration.yaml``: parameters that make poses as unsure as the calibration.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam_bags.reading.extrinsics import EXTRINSICS, StaticTransform, read_extrinsics
from slam_bags.storage.bag_calibration import FILE_NAME
from slam_core.camera import CameraInfo
from slam_core.camera_info import read_camera_info

_TOF_FILES = ("tof.yaml", "camera.yaml")
_SAME_TURN = 1e-6


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Cameras of a rig and where they sit; empty: what bag and drivers say counts.

    files: camera_info YAML by camera ("left", "right", "tof"). T_left_tof: of the rectified left camera, (4, 4).
    parameters: YAML files of parameters of the nodes.
    """

    files: Mapping[str, Path] = field(default_factory=dict)
    T_left_tof: StaticTransform | None = None
    parameters: tuple[Path, ...] = ()

    def info(self, camera: str) -> CameraInfo | None:
        """The camera info of "left", "right" or "tof", if it is known."""
        return read_camera_info(self.files[camera]).info if camera in self.files else None

    @property
    def is_given(self) -> bool:
        """True if anything is known."""
        return bool(self.files)

    def transforms(self, left_frame: str, tof_frame: str) -> tuple[StaticTransform, ...]:
        """The static transforms between the frames of the images; none without both cameras."""
        if self.T_left_tof is None or not (left_frame and tof_frame):
            return ()
        return (StaticTransform(left_frame, tof_frame, self.T_left_tof.pose),)

    def driver_parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of the driver nodes, by executable."""
        stereo = {f"{side}_info": str(self.files[side]) for side in ("left", "right") if side in self.files}
        tof = {"info": str(self.files["tof"])} if "tof" in self.files else {}
        return {"stereo_driver": stereo, "tof_driver": tof}


def read_rig_calibration(folders: Iterable[Path]) -> RigCalibration:
    """The calibration that one or more folders hold.

    Raises
    ------
    ValueError
        If a folder holds none, a file cannot be read, two folders calibrate one camera, or the depth camera was
        calibrated against another left camera.
    """
    files: dict[str, Path] = {}
    parameters: list[Path] = []
    extrinsics: list[Path] = []
    for folder in folders:
        found = _cameras_in(folder)
        if twice := sorted(files.keys() & found.keys()):
            raise ValueError(f"{folder} and {files[twice[0]].parent} both calibrate the camera {', '.join(twice)}")
        files |= found
        parameters += [folder / FILE_NAME] * (folder / FILE_NAME).is_file()
        extrinsics += [folder / EXTRINSICS] * ("tof" in found and (folder / EXTRINSICS).is_file())
    for path in files.values():
        read_camera_info(path)
    T_left_tof = read_extrinsics(extrinsics[0]) if extrinsics else None
    if extrinsics and "left" in files:
        _require_same_left(extrinsics[0].parent / "left.yaml", files["left"])
    return RigCalibration(files, T_left_tof, tuple(parameters))


def _cameras_in(folder: Path) -> dict[str, Path]:
    sides = {side: folder / f"{side}.yaml" for side in ("left", "right")}
    found = sides if all(path.is_file() for path in sides.values()) else {}
    depth = [path for name in _TOF_FILES if (path := folder / name).is_file()]
    if depth:
        found["tof"] = depth[0]
    if not found:
        raise ValueError(
            f"{folder} holds no calibration: neither left.yaml with right.yaml, nor tof.yaml or camera.yaml, as slam "
            "calibrate writes them"
        )
    return {camera: path.resolve() for camera, path in found.items()}


def _require_same_left(own: Path, stereo: Path) -> None:
    """The left camera's frame is that of its rectified images: it must be the same in both calibrations."""
    if not own.is_file() or np.abs(read_camera_info(own).info.R - read_camera_info(stereo).info.R).max() > _SAME_TURN:
        raise ValueError(
            f"{own.parent} was calibrated against another left camera than {stereo}: run slam calibrate stereo-tof "
            f"again with --left-info {stereo}"
        )
