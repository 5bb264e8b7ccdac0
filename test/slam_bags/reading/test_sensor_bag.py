# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.readings import DepthReading, ImuReading, StereoReading
from slam_bags.reading.sensor_bag import SensorBag
from slam_bags.reading.sensor_topics import topics_of
from slam_bags.storage.bag import BagWriter
from slam_bags.storage.sensor_writer import (
    IMU_FRAME,
    LEFT_FRAME,
    RIGHT_FRAME,
    T_BASE_OPTICAL,
    TOF_FRAME,
    SensorWriter,
)
from slam_core.camera import Camera
from slam_core.geometry import boxplus, make_transform, so3_exp
from slam_core.messages import rectified_info
from slam_core.types import ImuSample

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
INFOS = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)
T_BASE_IMU = make_transform(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.1, 0.0, 0.0]))
T_BASE_TOF = boxplus(T_BASE_OPTICAL, np.array([0.0, 0.0, -0.05, 0.01, 0.0, 0.0]))


def picture(value: int) -> np.ndarray:
    return np.full((12, 16), value, np.uint8)


def write_agent(bag: BagWriter, agent: str = "") -> None:
    writer = SensorWriter(bag, agent)
    frames = {LEFT_FRAME: T_BASE_OPTICAL, RIGHT_FRAME: T_BASE_OPTICAL, TOF_FRAME: T_BASE_TOF, IMU_FRAME: T_BASE_IMU}
    writer.extrinsics(100, frames)
    for i in range(3):
        stamp = 100 + 10 * i
        writer.stereo(stamp, picture(i), picture(i + 100), INFOS)
        depth = np.full((12, 16), 1000 + i, np.uint16)
        writer.depth(stamp, depth, rectified_info(CAMERA), measurement="depth", amplitude=picture(50))
        writer.imu(ImuSample(stamp, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 9.8])))
        writer.ground_truth(stamp, boxplus(np.eye(4), np.full(6, 0.01 * i)))


def test_readings_are_paired_and_of_one_stamp_depth_comes_before_stereo(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_agent(bag)
    with SensorBag(tmp_path / "bag") as opened:
        readings = list(opened.readings())
        sensors = opened.sensors[""]
        truth = opened.ground_truth("")
    assert [type(r) for r in readings] == [ImuReading, DepthReading, StereoReading] * 3
    depth, stereo = readings[4], readings[5]
    assert isinstance(depth, DepthReading)
    assert isinstance(stereo, StereoReading)
    assert (stereo.pair.left[0, 0], stereo.pair.right[0, 0], stereo.stamp_ns) == (1, 101, 110)
    assert (depth.raw.image[0, 0], depth.raw.image.dtype, sensors.measurement) == (1001, np.uint16, "depth")
    assert depth.raw.intensity is None
    assert truth is not None
    np.testing.assert_allclose(truth.poses[2][:3, 3], 0.02)
    assert not opened.left_out


def test_true_poses_are_read_along_with_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_agent(bag)
    with SensorBag(tmp_path / "bag") as opened:
        first = opened.ground_truth("")
        assert list(opened.readings())
        monkeypatch.setattr(opened.reader, "raw", None)
        second = opened.ground_truth("")
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.stamps_ns, second.stamps_ns)


def test_imu_readings_keep_the_axes_of_the_imu(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_agent(bag)
    with SensorBag(tmp_path / "bag") as opened:
        reading = next(opened.readings())
    assert isinstance(reading, ImuReading)
    np.testing.assert_allclose(reading.sample.angular_velocity, [1.0, 0.0, 0.0])
    assert reading.sample.frame_id == IMU_FRAME


def test_extrinsics_and_calibration_of_every_agent(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for agent in ("fireman_1", "fireman_2"):
            write_agent(bag, agent)
    with SensorBag(tmp_path / "bag") as opened:
        assert opened.agents == ("fireman_1", "fireman_2")
        sensors = opened.sensors["fireman_2"]
        assert {r.agent for r in opened.readings()} == {"fireman_1", "fireman_2"}
    assert sensors.right is not None
    assert sensors.right.baseline == pytest.approx(0.1)
    np.testing.assert_allclose(sensors.transform("base", "tof"), T_BASE_TOF, atol=1e-12)


def test_an_image_without_partner_is_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_agent(bag)
        SensorWriter(bag).picture("stereo/left/image_raw", 10**9, LEFT_FRAME, picture(1))
    with SensorBag(tmp_path / "bag") as opened:
        assert sum(isinstance(r, StereoReading) for r in opened.readings()) == 3
        assert opened.left_out == {"images without a partner within 4 ms of their stamp": 1}


def test_bags_without_cameras_or_calibration_are_refused(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        SensorWriter(bag).ground_truth(1, np.eye(4))
    with pytest.raises(ValueError, match=r"--topic left=.* Its topics: /ground_truth/pose"):
        SensorBag(tmp_path / "bag").__enter__()
    with BagWriter(tmp_path / "bag") as bag:
        for side, frame in (("left", LEFT_FRAME), ("right", RIGHT_FRAME)):
            SensorWriter(bag).picture(f"stereo/{side}/image_raw", 1, frame, picture(0))
    with pytest.raises(ValueError, match="no camera info on /stereo/left/camera_info"):
        SensorBag(tmp_path / "bag").__enter__()


def test_an_image_topic_without_messages_is_told_as_that(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for side in ("left", "right"):
            bag.declare(f"/stereo/{side}/image_raw", "sensor_msgs/msg/Image")
        SensorWriter(bag).ground_truth(1, np.eye(4))
    with pytest.raises(ValueError, match=r"no message on /stereo/left/image_raw: .* /ground_truth/pose 1"):
        SensorBag(tmp_path / "bag").__enter__()


def test_a_second_stereo_camera_is_told_of_and_other_images_of_a_used_one_are_not(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        write_agent(bag)
        for topic in ("tof/infra/image_rect_raw", "stereo_rear/left/image_raw", "stereo_rear/right/image_raw"):
            SensorWriter(bag).picture(topic, 100, LEFT_FRAME, picture(1))
    with SensorBag(tmp_path / "bag") as opened:
        warnings = " ".join(opened.warnings)
    assert "of other cameras: /stereo_rear/left/image_raw, /stereo_rear/right/image_raw (--topic)" in warnings


def test_a_laser_is_used_where_there_is_no_depth_camera():
    left, tof = ("/stereo/left/image_raw", "/stereo/right/image_raw", "/scan"), "/tof/depth/image_raw"
    assert topics_of("", left, {})["scan"] == "/scan"
    assert "scan" not in topics_of("", (*left, tof), {})
    with pytest.raises(ValueError, match="leave the topic of 'scan' out"):
        topics_of("", (*left, tof), {"scan": "/scan"})
