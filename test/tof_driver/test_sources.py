# SPDX-License-Identifier: Apache-2.0
"""Depth images from folders, from videos without loss, and from a software device of librealsense, if installed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam_core.nodes.frame_sources import FrameCapture
from tof_driver.sources import DepthFolder, DepthVideo, RealSense, depth_of, info_of

NAMES = ("range", "amplitude", "intensity")


def ramp(start: int, width: int = 30) -> np.ndarray:
    return (start + np.arange(20 * width, dtype=np.uint16)).reshape(20, width)


def write_image(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_video(path, frames):
    grey_16 = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0, cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    size = frames[0].shape[::-1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 20.0, size, grey_16)
    for frame in frames:
        writer.write(frame)
    writer.release()


def readings(source):
    return list(iter(source.read, None))


def test_a_folder_gives_what_all_its_subfolders_have(tmp_path):
    for k, stamp in enumerate((1403715273262142976, 1403715273312143104)):
        for n, name in enumerate(NAMES):
            write_image(tmp_path / name / f"{stamp}.png", ramp(1000 * n + k))
    write_image(tmp_path / "range" / "1403715273412143104.png", ramp(0))
    found = readings(DepthFolder(tmp_path, NAMES))
    assert [raw.stamp_ns for raw in found] == [1403715273262142976, 1403715273312143104]
    for k, raw in enumerate(found):
        for n, image in enumerate((raw.image, raw.amplitude, raw.intensity)):
            np.testing.assert_array_equal(image, ramp(1000 * n + k))


def test_float_metres_and_colours_are_read_and_numbers_are_places_in_time(tmp_path):
    metres = np.linspace(0.5, 3.0, 600, dtype=np.float32).reshape(20, 30)
    for k in range(2):
        write_image(tmp_path / "depth" / f"{k}.tiff", metres)
        write_image(tmp_path / "color" / f"{k}.tiff", np.full((20, 30, 3), (0, 0, 100), np.uint8))
    found = readings(DepthFolder(tmp_path, ("depth", "color"), rate=20.0))
    assert [raw.stamp_ns for raw in found] == [0, 50_000_000]
    np.testing.assert_array_equal(found[0].image, metres)
    assert (found[0].amplitude == 30).all()
    assert found[0].intensity is None


def test_a_folder_without_images_of_one_name_is_refused(tmp_path):
    write_image(tmp_path / "range" / "1.png", ramp(0))
    write_image(tmp_path / "amplitude" / "2.png", ramp(0))
    with pytest.raises(ValueError, match="range,amplitude"):
        DepthFolder(tmp_path, ("range", "amplitude"))


def test_a_video_gives_its_images_to_the_last_bit(tmp_path):
    write_video(tmp_path / "tof.mkv", [np.hstack([ramp(1000 * n + k, 32) for n in range(3)]) for k in range(2)])
    source = DepthVideo(str(tmp_path / "tof.mkv"), NAMES)
    found = readings(source)
    source.close()
    assert source.rate == 20.0
    assert [raw.stamp_ns for raw in found] == [0, 50_000_000]
    for k, raw in enumerate(found):
        for n, image in enumerate((raw.image, raw.amplitude, raw.intensity)):
            np.testing.assert_array_equal(image, ramp(1000 * n + k, 32))


def test_a_video_of_another_kind_is_refused(tmp_path):
    write_video(tmp_path / "tof.mkv", [ramp(0, 32)])
    with pytest.raises(ValueError, match="3 images of one width"):
        DepthVideo(str(tmp_path / "tof.mkv"), NAMES).read()
    with pytest.raises(OSError, match="cannot open"):
        FrameCapture(str(tmp_path / "none.mkv"), raw=True)


def test_librealsense_gives_metres_and_its_calibration():
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy = 64, 48, 60.0, 61.0
    intrinsics.ppx, intrinsics.ppy, intrinsics.model = 31.5, 23.5, rs.distortion.brown_conrady
    stream = rs.video_stream()
    stream.type, stream.uid, stream.width, stream.height = rs.stream.depth, 0, 64, 48
    stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, 2, rs.format.z16, intrinsics
    device, queue, frame = rs.software_device(), rs.frame_queue(1), rs.software_video_frame()
    sensor = device.add_sensor("depth")
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, 0.0005)
    sensor.open(profile)
    sensor.start(queue)
    frame.pixels, frame.stride, frame.bpp, frame.frame_number = np.full((48, 64), 3000, np.uint16), 128, 2, 1
    frame.profile, frame.depth_units = profile.as_video_stream_profile(), 0.0005
    sensor.on_video_frame(frame)
    got = queue.wait_for_frame(2000).as_depth_frame()
    np.testing.assert_allclose(depth_of(got, 7).image, 1.5)
    camera = info_of(got.profile.as_video_stream_profile().get_intrinsics()).camera
    assert (camera.width, camera.fx, camera.fy, camera.cx, camera.distortion) == (64, 60.0, 61.0, 31.5, ())
    intrinsics.model, intrinsics.coeffs = rs.distortion.ftheta, [0.1] * 5
    with pytest.raises(ValueError, match="ftheta"):
        info_of(intrinsics)
    sensor.stop()
    sensor.close()


def test_without_librealsense_or_a_camera_the_reason_is_said():
    with pytest.raises(OSError, match="librealsense"):
        RealSense("", lambda: 0)
