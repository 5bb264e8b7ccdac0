# SPDX-License-Identifier: Apache-2.0
"""``stereo_driver`` and ``feature_extractor`` as real processes over real topics: the features of the offline front
end.
"""

from __future__ import annotations

import itertools
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

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from sensor_msgs.msg import CameraInfo as InfoMessage  # noqa: E402
from sensor_msgs.msg import Image, PointCloud2  # noqa: E402
from sensor_msgs.srv import SetCameraInfo  # noqa: E402

from ros_probe import Probe  # noqa: E402
from slam_core.camera import Camera, CameraInfo  # noqa: E402
from slam_core.camera_info import CameraInfoFile, read_camera_info  # noqa: E402
from slam_core.messages import (  # noqa: E402
    FEATURE_TOPICS,
    camera_info_message,
    features_from_messages,
    header_message,
    image_from_message,
    image_message,
)
from slam_core.types import StereoImages  # noqa: E402
from stereo_frontend.frontend import Frontend  # noqa: E402
from stereo_frontend.frontend_config import FrontendConfig  # noqa: E402
from stereo_frontend.stereo.rectify import StereoRectifier  # noqa: E402

pytestmark = pytest.mark.ros

LENS = Camera(320, 240, 198.0, 199.0, 158.0, 123.0, "plumb_bob", (-0.05, 0.01, 1e-4, 0.0, 0.0))
P = np.array([[200.0, 0, 160, 0], [0, 200.0, 120, 0], [0, 0, 1, 0]])
INFOS = {"left": CameraInfo(LENS, P=P), "right": CameraInfo(LENS, P=P - np.array([[0, 0, 0, 24.0], [0] * 4, [0] * 4]))}
RECTIFIED = {side: CameraInfo(info.rectified, P=info.P) for side, info in INFOS.items()}
SIDES = ("left", "right")


class PairProbe(Probe):
    """Sends raw pairs."""

    def send_pair(
        self, stamp: int, pair: StereoImages, encoding: str = "mono8", infos: dict[str, CameraInfo] = INFOS
    ) -> None:
        for side, image in zip(SIDES, (pair.left, pair.right), strict=True):
            header = header_message(self.types, stamp, f"stereo_{side}_optical_frame")
            if infos:
                self.send(f"stereo/{side}/camera_info", camera_info_message(self.types, header, infos[side]))
            message = image_message(self.types, header, image)
            message.encoding = encoding
            self.send(f"stereo/{side}/image_raw", message)


@pytest.fixture
def probe(domain: int) -> Iterator[PairProbe]:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    probe = PairProbe(context)
    yield probe
    probe.executor.shutdown()
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def start(probe: PairProbe) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a node of the package with parameters; all end cleanly."""
    running: list[subprocess.Popen[str]] = []

    def run(module: str, **parameters: object) -> subprocess.Popen[str]:
        given = [a for name, value in parameters.items() for a in ("-p", f"{name}:={value}")]
        code = f"from stereo_frontend.{module} import main; main()"
        command = [sys.executable, "-c", code, "--ros-args", "-p", "input.policy:=all", *given]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        running.append(subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True))
        return running[-1]

    yield run
    for process in running:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)


def test_raw_pairs_become_the_features_of_the_offline_front_end(probe, start, stereo_pair):
    for topic, kind in zip(FEATURE_TOPICS, (PointCloud2, Image, InfoMessage), strict=True):
        probe.listen(topic, kind)
    probe.listen("features/image", Image)
    start("driver_node")
    start("node")
    pairs = [stereo_pair(seed=s) for s in (1, 2)]
    for side in SIDES:
        for topic in (f"stereo/{side}/image_rect", f"stereo/{side}/camera_info"):
            probe.wait(lambda t=topic: probe.node.count_subscribers(t) > 0, f"no subscriber to {topic}")
        probe.wait(lambda s=side: probe.node.count_publishers(f"stereo/{s}/image_rect") > 0, "no driver")
    stamp = 10_000_000_000
    while not all(probe.received[t] for t in (*FEATURE_TOPICS, "features/image")):  # until all have found each other
        assert stamp < 16_000_000_000, "no features"
        probe.send_pair(stamp, pairs[0])
        probe.spin(1.0)
        stamp += 100_000_000
    probe.spin(1.0)
    for messages in probe.received.values():
        messages.clear()
    # The stamps now jump back: both nodes start anew.
    for k, pair in enumerate(pairs):
        probe.send_pair(1_000_000_000 + k * 100_000_000, pair)
    probe.send_pair(1_200_000_000, pairs[0], encoding="nonsense")
    probe.send_pair(1_300_000_000, pairs[0])
    outputs = [probe.received[t] for t in FEATURE_TOPICS]
    probe.wait(lambda: all(len(o) == 3 for o in outputs) and bool(probe.received["features/image"]), "no features")
    rectifier, frontend = StereoRectifier(INFOS["left"], INFOS["right"]), Frontend(FrontendConfig())
    for k, pair in enumerate([*pairs, pairs[0]]):
        expected = frontend.process(rectifier(0, pair.left, pair.right))
        got = features_from_messages(*(o[k] for o in outputs))
        assert len(got) == len(expected) > 50
        for field in ("xyz", "uv", "sigma_uv", "sigma_depth", "descriptors", "source"):
            np.testing.assert_array_equal(getattr(got, field), getattr(expected, field))
    assert image_from_message(probe.received["features/image"][0]).shape == (240, 320, 3)


def test_a_folder_of_images_is_played_with_its_calibration(probe, start, stereo_pair, tmp_path: Path):
    pair = stereo_pair()
    for side, image in zip(SIDES, (pair.left, pair.right), strict=True):
        (tmp_path / side).mkdir()
        for name in ("1000000000000000000", "1000000000100000000"):
            cv2.imwrite(str(tmp_path / side / f"{name}.png"), image)
        CameraInfoFile(INFOS[side], side).write(tmp_path / f"{side}.yaml")
        probe.listen(f"stereo/{side}/image_rect", Image)
    probe.listen("stereo/left/camera_info", InfoMessage)
    files = {f"{side}_info": tmp_path / f"{side}.yaml" for side in SIDES}
    start("driver_node", source="folder", path=tmp_path, rate=0.5, **files)
    probe.wait(lambda: all(probe.received[f"stereo/{s}/image_rect"] for s in SIDES), "no rectified images")
    probe.wait(lambda: bool(probe.received["stereo/left/camera_info"]), "no camera info")
    rectifier = StereoRectifier(INFOS["left"], INFOS["right"])
    message = probe.received["stereo/left/image_rect"][0]
    np.testing.assert_array_equal(image_from_message(message), rectifier(0, pair.left, pair.right).left)
    assert message.header.stamp.sec == 1_000_000_000


def test_a_new_calibration_is_written_and_used(probe, start, tmp_path: Path):
    paths = {side: tmp_path / f"{side}.yaml" for side in SIDES}
    for side in SIDES:
        CameraInfoFile(INFOS[side], side).write(paths[side])
    start("driver_node", **{f"{side}_info": paths[side] for side in SIDES})
    new = CameraInfo(Camera(320, 240, 190.0, 190.0, 158.0, 123.0), P=P)
    header = header_message(probe.types, 0, "stereo_left_optical_frame")
    request = SetCameraInfo.Request(camera_info=camera_info_message(probe.types, header, new))
    answer = probe.call("stereo/left/set_camera_info", request, SetCameraInfo)
    assert answer.success, answer.status_message
    assert read_camera_info(paths["left"]).info.camera.fx == 190.0


def test_pairs_under_another_calibration_are_rejected_until_the_node_is_reset(probe, start, stereo_pair):
    probe.listen("stereo/left/image_rect", Image)
    process, pair = start("driver_node"), stereo_pair()
    rectified, stamps = probe.received["stereo/left/image_rect"], itertools.count(10_000_000_000, 100_000_000)
    for _ in range(10):
        if not rectified:
            probe.send_pair(next(stamps), pair)
            probe.spin(0.5)
    rectified.clear()
    refocused = Camera(320, 240, 1.3 * LENS.fx, 1.3 * LENS.fy, LENS.cx, LENS.cy, "plumb_bob", LENS.distortion)
    new = {side: CameraInfo(refocused, P=info.P) for side, info in INFOS.items()}
    probe.send_pair(next(stamps), pair, infos=new)  # its images may overtake the infos
    probe.spin(1.0)
    rectified.clear()
    for _ in range(2):
        probe.send_pair(next(stamps), pair, infos=new)
    probe.spin(2.0)
    assert not rectified
    probe.call("stereo_driver/reset")
    probe.send_pair(next(stamps), pair, infos=new)
    probe.wait(lambda: bool(rectified), "nothing after the reset")
    expected = StereoRectifier(new["left"], new["right"])(0, pair.left, pair.right).left
    np.testing.assert_array_equal(image_from_message(rectified[0]), expected)
    process.send_signal(signal.SIGINT)
    assert "has changed (fx 198 to 257.4 px)" in process.communicate(timeout=30)[1]


def test_a_device_that_is_not_there_is_told_once_and_counted(probe, start, stereo_pair):
    probe.listen("/diagnostics", DiagnosticArray)
    start("driver_node")
    process = start("node", **{"features.device": "nonsense"})
    stamps, pair = itertools.count(10_000_000_000, 100_000_000), stereo_pair()

    def told() -> set[tuple[str, str]]:
        probe.send_pair(next(stamps), pair)
        statuses = [s for array in probe.received["/diagnostics"] for s in array.status]
        return {(value.key, value.value) for s in statuses for value in s.values}

    probe.wait(lambda: {("gpu_fallbacks", "1"), ("device", "cpu")} <= told(), "no fallback in the diagnostics")
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30)[1].count("SURF is computed on the CPU") == 1


def test_a_source_without_calibration_does_not_start(start, tmp_path: Path):
    process = start("driver_node", source="folder", path=tmp_path)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "left_info" in errors


def test_the_node_honours_masks_and_rejects_others(probe, start, stereo_pair):
    """Rectified images come in, and masks after them; one of 16 bits is rejected, one of another size said."""
    for topic, kind in zip(FEATURE_TOPICS, (PointCloud2, Image, InfoMessage), strict=True):
        probe.listen(topic, kind)
    probe.listen("/diagnostics", DiagnosticArray)
    start("node", **{"mask.use": "always"})
    pair, mask = stereo_pair(), np.zeros((240, 320), np.uint8)
    mask[:, 160:] = 255
    for topic in ("stereo/left/image_rect", "stereo/right/image_rect", "mask"):
        probe.wait(lambda t=topic: probe.node.count_subscribers(t) > 0, f"no subscriber to {topic}")

    def header(stamp: int, side: str = "left") -> object:
        return header_message(probe.types, stamp, f"stereo_{side}_optical_frame")

    def send(stamp: int, pixels: np.ndarray) -> None:
        for side, image in zip(SIDES, (pair.left, pair.right), strict=True):
            probe.send(f"stereo/{side}/camera_info", camera_info_message(probe.types, header(stamp), RECTIFIED[side]))
            probe.send(f"stereo/{side}/image_rect", image_message(probe.types, header(stamp, side), image))
        probe.send("mask", image_message(probe.types, header(stamp), pixels))

    outputs = [probe.received[t] for t in FEATURE_TOPICS]
    stamp = 1_000_000_000
    while not all(outputs):
        assert stamp < 8_000_000_000, "no features"
        send(stamp, mask)
        probe.spin(0.5)
        stamp += 100_000_000
    features = features_from_messages(*(o[-1] for o in outputs))
    assert len(features) > 30
    assert features.uv[:, 0].max() < 160
    send(stamp, mask.astype(np.uint16))
    send(stamp + 100_000_000, mask[::2, ::2])

    def values() -> dict[str, str]:
        status = [s for m in probe.received["/diagnostics"] for s in m.status if s.name.endswith("feature_extractor")]
        return {entry.key: entry.value for entry in status[-1].values} if status else {}

    probe.wait(lambda: values().get("masks_of_another_size") == "1", "not counted")
    assert values()["rejected"] == "1"
    assert "masks are 160 x 120 px, the rectified images 320 x 240 px" in values()["reason"]
    assert values()["state"] == "DEGRADED"
    assert int(values()["frames_masked"]) >= 1
