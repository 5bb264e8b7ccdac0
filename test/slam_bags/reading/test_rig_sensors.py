# SPDX-License-Identifier: Apache-2.0
"""Sensors beside the cameras of a rig in a bag: whose they are, which are used, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.rig_cameras import RigCameras
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import BagNames, topics_on_rig
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import LEFT_FRAME, RIGHT_FRAME, T_BASE_OPTICAL, SensorWriter
from slam_core.camera import Camera
from slam_core.messages import rectified_info
from slam_core.types import ImuSample, OdometryReading, PressureReading

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
INFOS = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)
PICTURE = np.zeros((12, 16), np.uint8)
IMU = ImuSample(100, np.zeros(3), np.array([0.0, 0.0, 9.8]))


def write_cameras(bag: BagWriter, *cameras: str) -> None:
    for camera in cameras:
        writer = SensorWriter(bag, camera=camera)
        writer.extrinsics(100, {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL})
        for stamp in (100, 110):
            writer.stereo(stamp, PICTURE, PICTURE, INFOS)


def rig_of(*cameras: str, topics: Mapping[str, str] | None = None, **other: str) -> BagNames:
    """Names of a ``rig.yaml``; ``other``: namespace of a camera, where it is not its name."""
    listed = {
        name: {side: f"/{other.get(name, name)}/stereo/{side}/image_raw" for side in ("left", "right")}
        for name in cameras
    }
    return BagNames(topics or {}, rig=RigCameras(listed))


def test_the_pressure_of_a_rig_is_its_first_cameras(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_cameras(bag, "front", "back")
        SensorWriter(bag).pressure(PressureReading(100, 1e5, 1.0))
    with SensorBag(tmp_path / "bag") as opened:
        assert opened.rigs == {"": ("back", "front")}
        assert opened.sensors["back"].topics["pressure"] == "/pressure"
        assert not opened.warnings


@pytest.mark.parametrize("own", ["odometry", "truth", "pressure", "imus"])
def test_namespaces_with_a_way_of_their_own_are_agents(tmp_path: Path, own: str) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_cameras(bag, "anna", "ben")
        for name in ("anna", "ben"):
            writer = SensorWriter(bag, name)
            if own == "odometry":
                writer.odometry(OdometryReading(100, np.eye(4), np.eye(6), np.zeros(6), np.eye(6)))
            elif own == "truth":
                writer.ground_truth(100, np.eye(4))
            elif own == "pressure":
                writer.pressure(PressureReading(100, 1e5, 1.0))
            else:
                writer.imu(IMU)
    with SensorBag(tmp_path / "bag") as opened:
        assert opened.rigs == {"anna": ("anna",), "ben": ("ben",)}
        role = {"truth": "ground_truth", "imus": "imu"}.get(own, own)
        assert [sensors.topics[role].split("/")[1] for sensors in opened.sensors.values()] == ["anna", "ben"]


def test_an_imu_in_a_camera_is_that_of_the_rig_unless_the_rig_has_one(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_cameras(bag, "front", "back")
        SensorWriter(bag, "front").imu(IMU)
    with SensorBag(tmp_path / "bag") as opened:
        assert [own.topics.get("imu") for own in opened.sensors.values()] == ["/front/imu", None]
        assert not opened.warnings
    with BagWriter(tmp_path / "both") as bag:
        write_cameras(bag, "front", "back")
        for name in ("front", "back", ""):
            SensorWriter(bag, name).imu(IMU)
    with SensorBag(tmp_path / "both") as opened:
        assert [own.topics.get("imu") for own in opened.sensors.values()] == ["/imu", None]
        assert opened.warnings == ["not used, for a rig has one of each: /back/imu, /front/imu (--topic)"]


def test_a_laser_is_not_registered_where_any_camera_has_depth() -> None:
    cameras = {"a": {"left": "/a/left", "scan": "/a/scan"}, "b": {"depth": "/b/depth"}}
    assert "scan" not in topics_on_rig("", cameras, ("/scan", "/a/scan"), {})[0]["a"]
    del cameras["b"]["depth"]
    found, unused = topics_on_rig("", cameras, ("/scan", "/a/scan"), {})
    assert found == {"a": {"left": "/a/left", "scan": "/scan"}, "b": {}}
    assert unused == ["/a/scan"]


def test_cameras_with_one_frame_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_cameras(bag, "front")
    with pytest.raises(ValueError, match=f"cameras front and again have one frame, 'front/{LEFT_FRAME}'"):
        SensorBag(tmp_path / "bag", rig_of("front", "again", again="front")).__enter__()


def test_a_listed_camera_that_never_was_there_is_left_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_cameras(bag, "front")
        for side in ("left", "right"):
            bag.declare(f"/back/stereo/{side}/image_raw", "sensor_msgs/msg/Image")
    with SensorBag(tmp_path / "bag", rig_of("front", "back")) as opened:
        assert opened.rigs == {"": ("front",)}
        assert opened.warnings[0] == "no message of camera back: it is left out"
        assert len(list(opened.readings())) == 2
    with pytest.raises(ValueError, match="no message on /back/stereo/left/image_raw"):
        SensorBag(tmp_path / "bag", rig_of("back")).__enter__()
    with pytest.raises(ValueError, match="the bag has no topic /side/stereo/left/image_raw"):
        SensorBag(tmp_path / "bag", rig_of("front", "side")).__enter__()


def test_a_topic_that_is_given_comes_before_those_of_rig_and_camera() -> None:
    cameras, known = {"a": {"left": "/a/left", "imu": "/a/imu"}, "b": {}}, ("/imu", "/a/imu", "/other")
    found, unused = topics_on_rig("", cameras, known, {"imu": "/other", "left": "/a/left"})
    assert found["a"] == {"left": "/a/left", "imu": "/other"}
    assert unused == ["/a/imu"]
