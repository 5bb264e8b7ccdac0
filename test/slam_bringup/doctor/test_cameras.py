# SPDX-License-Identifier: Apache-2.0
"""A rig with several cameras: what is no camera is looked at once, and cameras with one frame are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam_bags.reading.rig_cameras import RigCameras
from slam_bags.reading.sensor_topics import BagNames
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import IMU_FRAME, LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_bringup.doctor.cameras import check_rig
from slam_bringup.doctor.evidence import gather
from slam_core.camera import Camera
from slam_core.messages import rectified_info
from slam_core.types import ImuSample, PressureReading

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
INFOS = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)


def written(path: Path) -> Path:
    with BagWriter(path) as bag:
        rig = SensorWriter(bag)
        rig.extrinsics(100, {IMU_FRAME: np.eye(4)})
        for camera in ("front", "back"):
            writer = SensorWriter(bag, camera=camera)
            writer.extrinsics(100, {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL})
        for stamp in (100, 110, 120):
            rig.imu(ImuSample(stamp, np.zeros(3), np.array([0.0, 0.0, 9.8])))
            rig.pressure(PressureReading(stamp, 1e5, 1.0))
            for camera in ("front", "back"):
                picture = np.zeros((12, 16), np.uint8)
                SensorWriter(bag, camera=camera).stereo(stamp, picture, picture, INFOS)
    return path


def listed(*cameras: str, **topics: str) -> BagNames:
    named = {
        f"c{k}": {side: f"/{camera}/stereo/{side}/image_raw" for side in ("left", "right")}
        for k, camera in enumerate(cameras)
    }
    return BagNames(topics, rig=RigCameras(named))


def test_the_imu_and_pressure_of_a_rig_are_looked_at_once(tmp_path: Path) -> None:
    bag = written(tmp_path / "bag")
    for names in (None, listed("back", "front"), listed("back", "front", imu="/imu")):
        first, second = gather(bag, names)
        assert len(first.imu) == len(first.pressures) == 3
        assert len(second.imu) == len(second.pressures) == 0
        assert first.streams["imu"].topic == "/imu"
        assert not list(check_rig([first, second]))


def test_cameras_with_one_frame_are_told(tmp_path: Path) -> None:
    finding = next(check_rig(gather(written(tmp_path / "bag"), listed("front", "front"))))
    assert finding.prevents_mapping
    assert str(finding).startswith(f"one frame: cameras c0 and c1 have one frame, 'front/{LEFT_FRAME}'")
