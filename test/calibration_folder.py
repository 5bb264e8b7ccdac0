# SPDX-License-Identifier: Apache-2.0
"""A calibration folder like those of ``slam calibrate``, for a bag whose calibration is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slam_bags.reading.extrinsics import EXTRINSICS, extrinsics_text
from slam_bags.reading.sensor_bag import SensorBag
from slam_core.camera_info import CameraInfoFile
from slam_core.geometry import make_transform

BASELINE_FACTOR = 1.02
TOF_SHIFT_M = 0.01
TOF_FOCAL_FACTOR = 1.01


def write_calibrations(bag: Path, folder: Path) -> tuple[Path, Path]:
    """Folders of a stereo pair with a longer baseline, and of a ToF camera with another focal length and place."""
    with SensorBag(bag) as opened:
        sensors = opened.sensors[""]
    assert sensors.left is not None
    assert sensors.right is not None
    assert sensors.tof is not None
    P = sensors.right.P.copy()
    P[0, 3] *= BASELINE_FACTOR
    stereo, tof = folder / "stereo", folder / "tof"
    for made in (stereo, tof):
        made.mkdir(parents=True)
        CameraInfoFile(sensors.left, "left").write(made / "left.yaml")
    CameraInfoFile(replace(sensors.right, P=P), "right").write(stereo / "right.yaml")
    (stereo / "calibration.yaml").write_text("sjsam:\n  calibration.sigma_scale: 0.003\n")
    camera = replace(sensors.tof.camera, fx=TOF_FOCAL_FACTOR * sensors.tof.camera.fx)
    CameraInfoFile(replace(sensors.tof, camera=camera, P=np.hstack([camera.K, np.zeros((3, 1))])), "tof").write(
        tof / "tof.yaml"
    )
    shift = make_transform(np.eye(3), np.array([0.0, TOF_SHIFT_M, 0.0]))
    T = shift @ sensors.transform("left", "tof")
    (tof / EXTRINSICS).write_text(
        extrinsics_text("stereo_left_optical_frame", "tof_optical_frame", T, 1e-6 * np.eye(6)), encoding="utf-8"
    )
    return stereo, tof
