# SPDX-License-Identifier: Apache-2.0
"""Tags in pictures become features, and reach the filter through messages as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.frame_tree import FrameTree
from slam_core.geometry import FloatArray, make_transform, so3_exp, transform_points
from slam_core.tags import square, whole_tags
from slam_core.types import ByteArray, DepthImage, FeatureSource, StereoImages
from stereo_frontend.fiducials.detector import DICTIONARIES, TagConfig, TagDetector, dictionary_of
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.stage import FeatureStage

CAMERA, BASELINE, SIZE = Camera(640, 480, 500.0, 500.0, 320.0, 240.0), 0.1, 0.16
T_OPTICAL_TAG = make_transform(so3_exp(np.array([np.pi, 0.0, 0.0])) @ so3_exp(np.array([0.1, 0.3, 0.05])),
                               np.array([0.1, -0.05, 1.2]))  # fmt: skip


def picture(name: str, number: int, T: FloatArray, image: ByteArray | None = None) -> ByteArray:
    """A tag on a grey wall, drawn four times as large and averaged."""
    dictionary, scale = dictionary_of(name), 4
    cells = dictionary.markerSize + 4
    card = np.pad(cv2.aruco.generateImageMarker(dictionary, number, (cells - 2) * 16), 16, constant_values=235)
    corners = transform_points(T, square(SIZE * cells / (cells - 2)))
    seen = scale * (CAMERA.project(corners) + 0.5)
    side = float(len(card))
    source = np.array([[0, 0], [side, 0], [side, side], [0, side]]) - 0.5
    H = cv2.getPerspectiveTransform(source.astype(np.float32), (seen - 0.5).astype(np.float32))
    size = (scale * CAMERA.width, scale * CAMERA.height)
    large = np.full(size[::-1], 120, np.uint8) if image is None else cv2.resize(image, size)
    cv2.warpPerspective(card, H, size, large, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    small = cv2.resize(large, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (3, 3), 0.7))


def pair(name: str = "apriltag_36h11", number: int = 5) -> StereoImages:
    T_right = T_OPTICAL_TAG.copy()
    T_right[0, 3] -= BASELINE
    left, right = picture(name, number, T_OPTICAL_TAG), picture(name, number, T_right)
    return StereoImages(10, left, right, StereoCamera(CAMERA, BASELINE))


def stage(**tags: float | str) -> FeatureStage:
    return FeatureStage(FrontendConfig(tags=TagConfig(**tags)), FrameTree())


def measured(one: FeatureStage, images: StereoImages):
    one.add_images(images)
    return next(one.measure(frame) for frame in one.extracted())


@pytest.mark.parametrize("name", DICTIONARIES)
def test_every_dictionary_is_found_within_a_fraction_of_a_pixel(name: str) -> None:
    found = TagDetector(TagConfig(dictionary=name))(picture(name, 7, T_OPTICAL_TAG))
    assert list(found) == [7]
    true = CAMERA.project(transform_points(T_OPTICAL_TAG, square(SIZE)))
    assert np.abs(found[7] - true).max() < 0.35


def test_a_tag_becomes_four_features_at_its_corners() -> None:
    features = measured(stage(dictionary="apriltag_36h11", size=SIZE), pair())
    rows = whole_tags(features.track_ids)[5]
    assert (features.source[rows] == FeatureSource.TAG).all()
    error = features.xyz[rows] - transform_points(T_OPTICAL_TAG, square(SIZE))
    assert np.abs(error).max() < 0.01
    assert (np.abs(error[:, 2]) < 4 * features.sigma_depth[rows]).all()
    assert not features.descriptors[rows].any()


def test_without_a_dictionary_nothing_changes() -> None:
    plain, with_tags = measured(stage(), pair()), measured(stage(dictionary="apriltag_36h11", size=SIZE), pair())
    n = len(plain)
    assert len(with_tags) == n + 4
    np.testing.assert_array_equal(plain.uv, with_tags.uv[:n])
    assert not (plain.track_ids < 0).any()


def test_a_tag_of_another_size_is_refused_and_the_user_told() -> None:
    one = stage(dictionary="apriltag_36h11", size=0.1)
    for k in range(8):
        images = pair()
        assert not (measured(one, StereoImages(k, images.left, images.right, images.stereo)).track_ids < 0).any()
    assert one.counters["tags_that_do_not_fit"] == 8
    assert any("tags are 0.16" in advice or "tags are 0.15" in advice for advice in one.report().advice)


def test_a_number_that_a_picture_shows_twice_is_left_out() -> None:
    beside = T_OPTICAL_TAG.copy()
    beside[0, 3] -= 0.5
    both = picture("aruco_4x4_50", 3, beside, picture("aruco_4x4_50", 3, T_OPTICAL_TAG))
    assert TagDetector(TagConfig(dictionary="aruco_4x4_50"))(both) == {}


def test_a_depth_camera_sees_tags_in_its_intensity() -> None:
    config = FrontendConfig(mode="tof", tags=TagConfig(dictionary="apriltag_36h11", size=SIZE))
    n, t = T_OPTICAL_TAG[:3, 2], T_OPTICAL_TAG[:3, 3]
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = ((n @ t) / (rays @ n)).astype(np.float32)
    grey = picture("apriltag_36h11", 5, T_OPTICAL_TAG).astype(np.float32)
    image = DepthImage(10, depth, np.full_like(depth, 0.01), CAMERA, intensity=grey)
    one = FeatureStage(config, FrameTree())
    one.add_depth(image)
    features = next(one.measure(frame) for frame in one.extracted())
    rows = whole_tags(features.track_ids)[5]
    assert np.abs(features.xyz[rows] - transform_points(T_OPTICAL_TAG, square(SIZE))).max() < 0.02
