# SPDX-License-Identifier: Apache-2.0
"""camera_info YAML: what ROS tools write is read, what is written is read back, faults are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from slam_core.camera import Camera, CameraInfo
from slam_core.camera_info import CameraInfoFile, read_camera_info
from slam_core.geometry import so3_exp

ROS_FILE = """image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [430.15433, 0., 306.69180, 0., 430.60921, 227.22480, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.33758, 0.11161, -0.00029, -0.00030, 0.]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.65, 0., 322.79, 0., 0., 393.65, 241.09, 0., 0., 0., 1., 0.]
"""


def test_a_file_of_the_ros_calibrator_is_read(tmp_path: Path) -> None:
    path = tmp_path / "left.yaml"
    path.write_text(ROS_FILE)
    file = read_camera_info(path)
    camera = file.info.camera
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "plumb_bob")
    assert (camera.fx, camera.cy, camera.distortion[1]) == (430.15433, 227.2248, 0.11161)
    assert (file.camera_name, file.info.rectified.fx, dict(file.standard_deviations)) == (
        "narrow_stereo/left",
        393.65,
        {},
    )


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("none", ()),
        ("plumb_bob", (-0.3, 0.1, 0.001, -0.002, 0.01)),
        ("rational_polynomial", (0.1, 0.2, 0.001, -0.002, 0.01, 0.3, 0.2, 0.1)),
        ("equidistant", (0.01, -0.02, 0.003, -0.001)),
    ],
)
def test_what_is_written_is_read_back_exactly(model: str, distortion: tuple[float, ...], tmp_path: Path) -> None:
    camera = Camera(752, 480, 458.654321, 457.29, 367.215, 248.375, model, distortion)
    P = np.array([[436.2, 0, 364.4, -48.0], [0, 436.2, 256.9, 0], [0, 0, 1, 0]])
    info = CameraInfo(camera, so3_exp(np.array([0.01, -0.02, 0.003])), P)
    CameraInfoFile(info, "right", {"fx": 0.25, "k1": 0.001}).write(tmp_path / "out" / "right.yaml")
    back = read_camera_info(tmp_path / "out" / "right.yaml")
    assert back.info.camera == camera
    np.testing.assert_array_equal(back.info.R, info.R)
    np.testing.assert_array_equal(back.info.P, info.P)
    assert (back.camera_name, dict(back.standard_deviations)) == ("right", {"fx": 0.25, "k1": 0.001})
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["right.yaml"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_matrix": None}, "camera_matrix"),
        ({"camera_matrix": {"data": [1, 2, 3]}}, "3 x 3"),
        ({"camera_matrix": {"data": ["a"] * 9}}, "numbers"),
        ({"distortion_model": "kannala"}, "kannala"),
        ({"distortion_coefficients": {"data": [0.1] * 9}}, "5 distortion"),
        ({"image_width": 0}, "size"),
    ],
)
def test_faults_are_named_with_the_file(change: dict[str, object], message: str, tmp_path: Path) -> None:
    document = {**yaml.safe_load(ROS_FILE), **change}
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in document.items() if v is not None}))
    with pytest.raises(ValueError, match=message) as error:
        read_camera_info(path)
    assert "bad.yaml" in str(error.value)


@pytest.mark.parametrize("text", ["", "just text", "a: [1, 2", "- 1\n- 2\n"])
def test_no_camera_info_at_all(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"not (a camera_info )?YAML"):
        read_camera_info(path)
