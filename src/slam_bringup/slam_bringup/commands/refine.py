# SPDX-License-Identifier: Apache-2.0
"""``slam calibrate refine``: corrects a stereo calibration by what a recording shows of it, without a board."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from slam_bringup.bags.readings import StereoReading
from slam_bringup.bags.sensor_bag import SensorBag
from slam_core.camera import CameraInfo
from slam_core.camera_info import CameraInfoFile
from slam_core.files import atomic_text
from stereo_frontend.corrected_info import corrected_right
from stereo_frontend.frontend import Frontend
from stereo_frontend.rectify import StereoRectifier


def refine(bag: Path) -> tuple[tuple[CameraInfo, CameraInfo], dict[str, Any]]:
    """Corrected infos (left, right) of the first agent with a stereo camera, and the figures of the correction.

    Raises
    ------
    ValueError
        If the bag has no stereo camera, or shows nothing to correct.
    """
    with SensorBag(bag) as source:
        agent = next((a for a in source.agents if {"left", "right"} <= source.sensors[a].topics.keys()), None)
        if agent is None:
            raise ValueError(f"{bag} has no stereo images")
        left, right = source.sensors[agent].left, source.sensors[agent].right
        if left is None or right is None:
            raise ValueError(f"{bag} has stereo images without camera infos: calibrate with a board first")
        rectifier, frontend = StereoRectifier(left, right), Frontend()
        for reading in source.readings():
            if isinstance(reading, StereoReading) and reading.agent == agent:
                pair = reading.pair
                frontend.process(rectifier(pair.stamp_ns, pair.left, pair.right))
    calibration = frontend.self_calibration
    if calibration.error is None or not calibration.corrects:
        raise ValueError(f"the images show no significant error to correct: {calibration.figures()}")
    corrected, left_over = corrected_right(right, calibration.error)
    return (left, corrected), calibration.figures() | {"left_over_px": left_over}


def write_refined(folder: Path, infos: tuple[CameraInfo, CameraInfo], figures: dict[str, Any]) -> None:
    """``left.yaml``, ``right.yaml`` and ``summary.json``."""
    for name, info in zip(("left", "right"), infos, strict=True):
        CameraInfoFile(info, name).write(folder / f"{name}.yaml")
    atomic_text(folder / "summary.json", json.dumps(figures, indent=2) + "\n")
