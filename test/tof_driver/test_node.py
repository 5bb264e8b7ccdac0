# SPDX-License-Identifier: Apache-2.0
"""The ``tof_driver`` process over real topics: the same depth as offline, and bad messages survived."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed")

from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # noqa: E402
from sensor_msgs.srv import SetCameraInfo  # noqa: E402

from ros_probe import Probe  # noqa: E402
from slam_core.camera import Camera  # noqa: E402
from slam_core.camera import CameraInfo as Calibration  # noqa: E402
from slam_core.camera_info import CameraInfoFile, read_camera_info  # noqa: E402
from slam_core.messages import (  # noqa: E402
    camera_info_from_message,
    camera_info_message,
    cloud_from_message,
    header_message,
    image_from_message,
    image_message,
)
from tof_driver.depth import DepthConfig, DepthProcessor  # noqa: E402

pytestmark = pytest.mark.ros

LENS = Camera(64, 48, 90.0, 90.0, 31.0, 24.0, "plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0))
START = "from tof_driver.node import main; main()"


class DriverProbe(Probe):
    """Sends raw images."""

    def send_frame(self, stamp: int, distance: np.ndarray, **pictures: np.ndarray) -> None:
        for name, image in {"range": distance, **pictures}.items():
            header = header_message(self.types, stamp, "tof_optical_frame")
            self.send(f"tof/{name}/image_raw", image_message(self.types, header, image))


@pytest.fixture
def probe(domain: int) -> Iterator[DriverProbe]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = DriverProbe(context)
    yield probe
    probe.executor.shutdown(timeout_sec=2.0)
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    running: list[subprocess.Popen[bytes]] = []

    def launch(*parameters: str) -> subprocess.Popen[bytes]:
        arguments = ["--ros-args", *(part for p in parameters for part in ("-p", p)), "-p", "input.policy:=all"]
        running.append(subprocess.Popen([sys.executable, "-c", START, *arguments], stderr=subprocess.PIPE))
        return running[-1]

    yield launch
    for process in running:
        process.kill()
        process.wait()


def scene(stamp: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(stamp)
    distance = (2.0 + 0.01 * rng.normal(size=(48, 64))).astype(np.float32)
    return {
        "distance": distance,
        "amplitude": (600.0 / distance**2).astype(np.float32),
        "intensity": rng.uniform(0.0, 900.0, (48, 64)).astype(np.float32),
    }


def test_online_is_offline_and_bad_messages_are_survived(
    probe: DriverProbe, start: Callable[..., subprocess.Popen[bytes]]
) -> None:
    process = start("mask.maximum_range:=6.0")
    outputs = {
        "tof/depth/image": Image,
        "tof/noise/image": Image,
        "tof/points": PointCloud2,
        "tof/intensity/image": Image,
    }
    for topic, kind in outputs.items():
        probe.listen(topic, kind)
    probe.send_frame(1, **scene(1))  # before any camera info: kept until it comes
    header = header_message(probe.types, 1, "tof_optical_frame")
    probe.send("tof/camera_info", camera_info_message(probe.types, header, Calibration(LENS)))
    bad = {name: image[:20] for name, image in scene(2).items()}
    probe.send_frame(2, **bad)
    probe.send_frame(3, **scene(3))
    probe.wait(lambda: all(len(m) == 2 for m in probe.received.values()), "two of three frames should come out")
    processor = DepthProcessor(DepthConfig(), LENS)
    for index, stamp in enumerate((1, 3)):
        raw = scene(stamp)
        expected = processor.process(stamp, raw["distance"], raw["amplitude"], raw["intensity"])
        depth, noise, points, intensity = (probe.received[topic][index] for topic in outputs)
        assert depth.header.stamp.nanosec == stamp
        assert depth.header.frame_id == "tof_optical_frame"
        np.testing.assert_array_equal(image_from_message(depth), expected.depth)
        np.testing.assert_array_equal(image_from_message(noise), expected.sigma)
        np.testing.assert_array_equal(image_from_message(intensity), expected.intensity)
        np.testing.assert_array_equal(cloud_from_message(points)["sigma"], expected.sigma)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=10.0) == 0


def test_a_folder_is_played_with_its_calibration_and_broken_images_are_survived(
    probe: DriverProbe, start: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    CameraInfoFile(Calibration(LENS), "tof").write(tmp_path / "tof.yaml")
    names = [f"10000000{k}0000000000.tiff" for k in range(6)]
    for name in ("range", "amplitude", "intensity"):
        (tmp_path / name).mkdir()
        for k, file in enumerate(names):
            image = scene(k)["distance" if name == "range" else name]
            assert cv2.imwrite(str(tmp_path / name / file), image)
    (tmp_path / "range" / names[3]).write_bytes(b"no image")
    outputs = {"tof/depth/image": Image, "tof/range/image_raw": Image, "tof/camera_info": CameraInfo}
    for topic, kind in outputs.items():
        probe.listen(topic, kind)
    start("source:=folder", f"path:={tmp_path}", f"info:={tmp_path / 'tof.yaml'}", "rate:=0.5")
    stamps = [int(name[:-14]) for name in names]
    played = [stamps[k] for k in (2, 4, 5)]  # the first may be gone before the driver and this node know each other
    probe.wait(
        lambda: all(messages and messages[-1].header.stamp.sec == stamps[-1] for messages in probe.received.values()),
        "the last image should come out",
    )
    for messages in probe.received.values():
        assert [m.header.stamp.sec for m in messages if m.header.stamp.sec > stamps[1]] == played
    for depth, unprocessed in zip(*(probe.received[topic][-3:] for topic in list(outputs)[:2]), strict=True):
        raw = scene(stamps.index(depth.header.stamp.sec))
        expected = DepthProcessor(DepthConfig(), LENS).process(0, raw["distance"], raw["amplitude"], raw["intensity"])
        np.testing.assert_array_equal(image_from_message(depth), expected.depth)
        np.testing.assert_array_equal(image_from_message(unprocessed), raw["distance"])


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        (("source:=folder", "path:=."), b"needs the parameter info"),
        (("source:=librealsense",), b"gives depth alone"),
        (("source:=librealsense", "measurement:=depth"), b"librealsense"),
    ],
)
def test_a_source_that_cannot_be_opened_is_refused(
    start: Callable[..., subprocess.Popen[bytes]], parameters: tuple[str, ...], reason: bytes
) -> None:
    process = start(*parameters)
    assert process.wait(timeout=60.0) != 0
    assert process.stderr is not None
    assert reason in process.stderr.read()


def test_calibration_from_a_file_is_published_and_replaced(
    probe: DriverProbe, start: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    path = tmp_path / "tof.yaml"
    CameraInfoFile(Calibration(LENS), "tof").write(path)
    start(f"info:={path}", "pictures:=none")
    probe.listen("tof/camera_info", CameraInfo)
    probe.send_frame(1, scene(1)["distance"])
    probe.wait(lambda: len(probe.received["tof/camera_info"]) == 1, "the info of the file should be published")
    assert camera_info_from_message(probe.received["tof/camera_info"][0]).camera == LENS
    changed = Camera(64, 48, 95.0, 95.0, 31.0, 24.0)
    message = camera_info_message(probe.types, header_message(probe.types, 0, ""), Calibration(changed))
    answer = probe.call("tof/set_camera_info", SetCameraInfo.Request(camera_info=message), SetCameraInfo)
    assert answer.success, answer.status_message
    assert read_camera_info(path).info.camera == changed
    probe.send_frame(2, scene(2)["distance"])
    probe.wait(lambda: len(probe.received["tof/camera_info"]) == 2, "the new info should be in use")
    assert camera_info_from_message(probe.received["tof/camera_info"][1]).camera.fx == 95.0


def test_a_missing_calibration_file_refuses_to_start(start: Callable[..., subprocess.Popen[bytes]]) -> None:
    process = start("info:=/nowhere/tof.yaml")
    _, errors = process.communicate(timeout=30.0)
    assert process.returncode == 2
    assert b"/nowhere/tof.yaml" in errors


def test_frames_under_another_calibration_are_rejected_until_the_node_is_reset(
    probe: DriverProbe, start: Callable[..., subprocess.Popen[bytes]]
) -> None:
    probe.listen("tof/depth/image", Image)
    process = start()
    refocused = Camera(64, 48, 1.3 * LENS.fx, 1.3 * LENS.fy, LENS.cx, LENS.cy, "plumb_bob", LENS.distortion)
    depths, stamps = probe.received["tof/depth/image"], iter(range(10_000_000_000, 20_000_000_000, 100_000_000))

    def play(camera: Camera, until: Callable[[], bool], failure: str) -> None:
        """A frame and its calibration every half a second; what comes out of the first two may overtake the change."""
        for _ in range(20):
            stamp = next(stamps)
            header = header_message(probe.types, stamp, "tof_optical_frame")
            probe.send("tof/camera_info", camera_info_message(probe.types, header, Calibration(camera)))
            probe.send_frame(stamp, **scene(1))
            probe.spin(0.5)
            if until():
                return
        raise AssertionError(failure)

    play(LENS, lambda: bool(depths), "nothing under the first calibration")
    sent = iter(range(2))
    play(refocused, lambda: next(sent, None) is None, "")
    depths.clear()
    sent = iter(range(3))
    play(refocused, lambda: next(sent, None) is None, "")
    assert not depths
    probe.call("tof_driver/reset")
    play(refocused, lambda: bool(depths), "nothing after the reset")
    raw = scene(1)
    expected = DepthProcessor(DepthConfig(), refocused).process(1, raw["distance"], raw["amplitude"], raw["intensity"])
    np.testing.assert_array_equal(image_from_message(depths[-1]), expected.depth)
    process.send_signal(signal.SIGINT)
    assert "has changed (fx 90 to 117 px)" in process.communicate(timeout=30)[1].decode()
