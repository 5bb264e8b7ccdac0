# SPDX-License-Identifier: Apache-2.0
"""The front end on real pairs: EuRoC and KITTI."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.geometry import invert_transform
from slam_core.types import StereoImages
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend import Frontend
from stereo_frontend.stereo.rectify import StereoRectifier

pytestmark = pytest.mark.data


def grey(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def euroc(data_dir) -> list[StereoImages]:
    sensors, cameras = [], []
    for name in ("cam0", "cam1"):
        file = data_dir / "euroc_v101_micro95" / "MicroEurocDataset" / "mav0" / name / "sensor.yaml"
        sensors.append(yaml.safe_load(file.read_text().replace("%YAML:1.0", "")))
        s = sensors[-1]
        cameras.append(Camera(*s["resolution"], *s["intrinsics"], "plumb_bob", tuple(s["distortion_coefficients"])))
    left, right = cameras
    T_left, T_right = (np.array(s["T_BS"]["data"]).reshape(4, 4) for s in sensors)
    T = invert_transform(T_right) @ T_left
    distortions = [np.array(c.distortion) for c in cameras]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        left.K, distortions[0], right.K, distortions[1], (752, 480), T[:3, :3], T[:3, 3:], alpha=0
    )
    rectifier = StereoRectifier(CameraInfo(left, R1, P1), CameraInfo(right, R2, P2))
    files = sorted((data_dir / "euroc_v101_visnav100" / "euroc_V1").glob("*_0.jpg"))[::9]
    return [rectifier(k, grey(f), grey(f.with_name(f.name.replace("_0.", "_1.")))) for k, f in enumerate(files)]


@pytest.fixture(scope="module")
def kitti(data_dir) -> list[StereoImages]:
    folder = data_dir / "kitti_stereo_51x2" / "KITTI_sequence_1"
    P = np.loadtxt(folder / "calib.txt").reshape(-1, 3, 4)
    pairs = []
    for file in sorted((folder / "image_l").glob("*.png"))[::12]:
        left, right = grey(file), grey(folder / "image_r" / file.name)
        camera = Camera(left.shape[1], left.shape[0], P[0, 0, 0], P[0, 1, 1], P[0, 0, 2], P[0, 1, 2])
        pairs.append(StereoImages(0, left, right, StereoCamera(camera, -P[1, 0, 3] / P[1, 0, 0])))
    return pairs


def precision(pairs: list[StereoImages], detector: str) -> float:
    """Share of mutual best matches over the whole image that keep the row: no band is applied."""
    left, right = (FeatureExtractor(FeatureConfig(detector=detector)) for _ in range(2))
    good = total = 0
    for pair in pairs:
        a, b = left(pair.left), right(pair.right)
        similarity = a.descriptors @ b.descriptors.T
        best = similarity.argmax(axis=1)
        mutual = similarity.argmax(axis=0)[best] == np.arange(len(a))
        difference = (a.uv - b.uv[best])[mutual]
        good += int(np.sum((np.abs(difference[:, 1]) < 2.0) & (difference[:, 0] > 0.0)))
        total += int(mutual.sum())
    return good / total


@pytest.mark.parametrize("name", ["euroc", "kitti"])
def test_surf_matches_at_least_as_precisely_as_sift(name, request):
    pairs = request.getfixturevalue(name)
    assert precision(pairs, "surf") >= precision(pairs, "sift")


def test_euroc_gives_hundreds_of_features_inside_the_room(euroc):
    frontend = Frontend()
    for pair in euroc:
        features = frontend.process(pair)
        assert len(features) > 150
        assert np.percentile(features.depth, 2) > 0.5
        assert np.percentile(features.depth, 98) < 10.0


def test_kitti_disparities_agree_with_block_matching(kitti):
    frontend = Frontend()
    dense = cv2.StereoSGBM_create(0, 128, 7, 8 * 49, 32 * 49, 1, 0, 10, 100, 2)
    for pair in kitti:
        features = frontend.process(pair)
        assert len(features) > 100
        disparity = dense.compute(pair.left, pair.right).astype(np.float32) / 16.0
        u, v = np.round(features.uv).astype(int).T
        other = disparity[v, u]
        own = pair.stereo.camera.fx * pair.stereo.baseline / features.depth
        known = other > 0
        assert known.mean() > 0.6
        assert np.mean(np.abs(own - other)[known] < 1.5) > 0.95


def test_swapped_real_images_are_named_as_such(euroc, kitti):
    for pair in (euroc[1], kitti[1]):
        with pytest.raises(ValueError, match="swapped"):
            Frontend().process(dataclasses.replace(pair, left=pair.right, right=pair.left))


def test_a_darker_right_camera_costs_few_features(euroc):
    pair = euroc[2]
    darker = dataclasses.replace(pair, right=(0.6 * pair.right).astype(np.uint8))
    assert len(Frontend().process(darker)) > 0.85 * len(Frontend().process(pair))
