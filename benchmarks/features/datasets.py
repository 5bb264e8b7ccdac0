# SPDX-License-Identifier: Apache-2.0
"""Real stereo pairs for the feature benchmarks, rectified: EuRoC V1_01 and KITTI."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import yaml

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.geometry import invert_transform
from slam_core.types import StereoImages
from stereo_frontend.stereo.rectify import StereoRectifier

DATA = Path(os.environ.get("INDOOR_SLAM_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def euroc_infos(
    folder: Path = DATA / "euroc_v101_micro95" / "MicroEurocDataset" / "mav0",
) -> tuple[CameraInfo, CameraInfo]:
    """Left and right camera info of EuRoC from the two sensor.yaml, rectified by OpenCV."""
    cameras, T_body = [], []
    for name in ("cam0", "cam1"):
        sensor = yaml.safe_load((folder / name / "sensor.yaml").read_text().replace("%YAML:1.0", ""))
        distortion = tuple(sensor["distortion_coefficients"])
        cameras.append(Camera(*sensor["resolution"], *sensor["intrinsics"], "plumb_bob", distortion))
        T_body.append(np.array(sensor["T_BS"]["data"]).reshape(4, 4))
    T_right_left = invert_transform(T_body[1]) @ T_body[0]
    left, right = cameras
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        left.K, np.array(left.distortion), right.K, np.array(right.distortion), (left.width, left.height),
        T_right_left[:3, :3], T_right_left[:3, 3:], alpha=0,
    )  # fmt: skip
    return CameraInfo(left, R1, P1), CameraInfo(right, R2, P2)


def euroc_pairs(step: int = 1) -> Iterator[StereoImages]:
    """Every ``step``-th rectified pair of EuRoC V1_01."""
    rectifier = StereoRectifier(*euroc_infos())
    for left in sorted((DATA / "euroc_v101_visnav100" / "euroc_V1").glob("*_0.jpg"))[::step]:
        right = left.with_name(left.name.replace("_0.", "_1."))
        yield rectifier(int(left.name.split("_")[0]), _grey(left), _grey(right))


def kitti_pairs(step: int = 1) -> Iterator[StereoImages]:
    """Every ``step``-th pair of the KITTI excerpt, rectified as published."""
    folder = DATA / "kitti_stereo_51x2" / "KITTI_sequence_1"
    P = np.loadtxt(folder / "calib.txt").reshape(-1, 3, 4)
    for number, left in enumerate(sorted((folder / "image_l").glob("*.png"))[::step]):
        images = _grey(left), _grey(folder / "image_r" / left.name)
        height, width = images[0].shape
        camera = Camera(width, height, P[0, 0, 0], P[0, 1, 1], P[0, 0, 2], P[0, 1, 2])
        yield StereoImages(number * 100_000_000, *images, StereoCamera(camera, -P[1, 0, 3] / P[1, 0, 0]))


def _grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise OSError(f"cannot read image {path}")
    return image
