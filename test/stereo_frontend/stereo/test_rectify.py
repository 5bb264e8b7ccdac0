# SPDX-License-Identifier: Apache-2.0
"""Rectification against the camera model itself, and its refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import so3_exp
from stereo_frontend.stereo.rectify import (
    FixedPointMap,
    Rectifier,
    StereoRectifier,
    rectification_map,
    stereo_camera_from_infos,
)

P_LEFT = np.array([[200.0, 0, 160, 0], [0, 200.0, 120, 0], [0, 0, 1, 0]])
P_RIGHT = P_LEFT + np.array([[0, 0, 0, -200.0 * 0.12], [0, 0, 0, 0], [0, 0, 0, 0]])
LENSES = {
    "plumb_bob": (-0.28, 0.07, 2e-4, 2e-5, 0.0),
    "rational_polynomial": (0.1, -0.05, 1e-4, -2e-4, 0.01, 0.3, 0.02, 0.003),
    "equidistant": (0.02, -0.01, 0.004, -0.001),
}


def raw_camera(model: str) -> Camera:
    return Camera(320, 240, 198.0, 199.0, 158.0, 123.0, model, LENSES[model])


@pytest.mark.parametrize("model", LENSES)
def test_the_map_leads_every_rectified_pixel_to_the_raw_pixel_of_the_same_ray(model, rng):
    R = so3_exp(np.array([0.02, -0.03, 0.01]))
    info = CameraInfo(raw_camera(model), R, P_LEFT)
    points = rng.uniform([-1, -0.7, 1.5], [1, 0.7, 4.0], (200, 3))
    rectified = info.rectified.project(points @ R.T)
    inside = np.all((rectified > 1) & (rectified < [318, 238]), axis=1)
    u, v = np.round(rectified[inside]).astype(int).T
    at_pixel = info.rectified.unproject(np.column_stack([u, v]).astype(float), np.ones(len(u))) @ R
    np.testing.assert_allclose(rectification_map(info, info.rectified)[v, u], info.camera.project(at_pixel), atol=1e-9)


def test_a_rectified_point_lies_on_one_row_at_the_right_disparity():
    tilt = so3_exp(np.array([0.01, 0.02, -0.015]))
    left = CameraInfo(raw_camera("plumb_bob"), np.eye(3), P_LEFT)
    right = CameraInfo(raw_camera("plumb_bob"), tilt, P_RIGHT)
    point = np.array([0.2, -0.1, 2.0])
    in_right = (point - [0.12, 0, 0]) @ tilt
    raw = [left.camera.project(point[None])[0], right.camera.project(in_right[None])[0]]
    images = [spot(pixel) for pixel in raw]
    pair = StereoRectifier(left, right)(7, *images)
    found = [centroid(pair.left), centroid(pair.right)]
    np.testing.assert_allclose(found[0], pair.stereo.camera.project(point[None])[0], atol=0.05)
    assert found[0][1] == pytest.approx(found[1][1], abs=0.05)
    assert found[0][0] - found[1][0] == pytest.approx(200 * 0.12 / 2.0, abs=0.05)


def test_colours_lie_on_the_rectified_left_image(rng):
    left, right = (
        CameraInfo(raw_camera("plumb_bob"), so3_exp(np.array([0.02, -0.01, 0.03])), P) for P in (P_LEFT, P_RIGHT)
    )
    colour = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    for channel in range(3):
        pair = StereoRectifier(left, right)(
            7, np.ascontiguousarray(colour[..., channel]), colour[..., 0].copy(), lambda: colour
        )
        np.testing.assert_array_equal(pair.colour()[..., channel], pair.left)


def test_a_right_image_is_rectified_once_and_only_if_asked_for(rng, monkeypatch):
    left, right = (CameraInfo(raw_camera("plumb_bob"), P=P) for P in (P_LEFT, P_RIGHT))
    images, made = rng.integers(0, 256, (2, 240, 320), dtype=np.uint8), []
    grey = FixedPointMap.grey
    monkeypatch.setattr(FixedPointMap, "grey", lambda *a: made.append(a) or grey(*a))
    pair = StereoRectifier(left, right)(7, *images, frame_id="eye")
    assert len(made) == 1
    assert pair.frame_id == "eye"
    np.testing.assert_array_equal(pair.right, Rectifier(right, left.rectified)(images[1]))
    made.clear()
    assert pair.right is pair.right
    assert not made


def test_each_calibration_has_a_map_of_its_own_that_is_made_once():
    raw, turned = raw_camera("plumb_bob"), so3_exp(np.array([0.02, -0.01, 0.03]))
    infos = [
        CameraInfo(raw, P=P_LEFT),
        CameraInfo(raw, turned, P_LEFT),
        CameraInfo(raw_camera("equidistant"), P=P_LEFT),
    ]
    target = infos[0].rectified
    wider = Camera(400, 240, 200.0, 200.0, 200.0, 120.0)
    maps = [FixedPointMap.between(info, target) for info in infos] + [FixedPointMap.between(infos[0], wider)]
    assert len({mapped.offset.tobytes() for mapped in maps}) == 4
    assert FixedPointMap.between(infos[0], wider) is maps[-1]


def test_a_wrong_right_image_is_refused_before_it_is_asked_for():
    left, right = (CameraInfo(raw_camera("plumb_bob"), P=P) for P in (P_LEFT, P_RIGHT))
    good, small = np.zeros((240, 320), np.uint8), np.zeros((120, 320), np.uint8)
    with pytest.raises(ValueError, match="its camera info says"):
        StereoRectifier(left, right)(7, good, small)


def spot(pixel: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    return (250 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 18.0)).astype(np.uint8)


def centroid(image: np.ndarray) -> tuple[float, float]:
    v, u = np.indices(image.shape)
    return float((u * image).sum() / image.sum()), float((v * image).sum() / image.sum())


def test_a_principal_point_of_its_own_in_the_right_P_gives_no_disparity_offset():
    shifted = P_RIGHT.copy()
    shifted[0, 2] += 5.0
    camera = Camera(320, 240, 200.0, 200.0, 165.0, 120.0)
    rectifier = StereoRectifier(
        CameraInfo(Camera(320, 240, 200.0, 200.0, 160.0, 120.0), P=P_LEFT), CameraInfo(camera, P=shifted)
    )
    pair = rectifier(0, spot(np.array([160.0, 120.0])), spot(np.array([165.0, 120.0])))
    assert centroid(pair.left)[0] == pytest.approx(centroid(pair.right)[0], abs=0.05)


def test_a_rectified_image_passes_untouched(rng):
    info = CameraInfo(Camera(320, 240, 200.0, 200.0, 160.0, 120.0), P=P_LEFT)
    image = rng.integers(0, 256, (240, 320), dtype=np.uint8)
    image.flags.writeable = False  # as in a message
    passed = Rectifier(info)(image)
    np.testing.assert_array_equal(passed, image)
    assert passed.flags.writeable


def test_swapped_infos_are_named_as_such():
    left, right = (CameraInfo(raw_camera("plumb_bob"), P=P) for P in (P_LEFT, P_RIGHT))
    with pytest.raises(ValueError, match="left and right are swapped"):
        stereo_camera_from_infos(right, left)


def test_infos_without_baseline_or_of_two_sizes_are_refused():
    left = CameraInfo(raw_camera("plumb_bob"), P=P_LEFT)
    with pytest.raises(ValueError, match="baseline"):
        StereoRectifier(left, left)
    other = CameraInfo(Camera(640, 480, 200.0, 200.0, 160.0, 120.0), P=P_RIGHT)
    with pytest.raises(ValueError, match="differ in size"):
        StereoRectifier(left, other)


@pytest.mark.parametrize(
    "image", [np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.uint16), np.zeros((120, 320), np.uint8)]
)
def test_images_of_the_wrong_kind_are_refused(image):
    rectifier = Rectifier(CameraInfo(raw_camera("plumb_bob"), P=P_LEFT))
    with pytest.raises(ValueError, match="image"):
        rectifier(image)


def test_grey_images_are_to_the_byte_what_opencv_makes_of_them(rng):
    image = rng.integers(0, 256, (60, 80), dtype=np.uint8)
    pixels = rng.uniform([-3.0, -3.0], [83.0, 63.0], (50, 70, 2)).astype(np.float32)
    pixels[:5] = np.rint(pixels[:5])
    pixels[5, :4] = [[0.0, 0.0], [79.0, 59.0], [78.99, 58.99], [-10.0, -10.0]]
    mapped = FixedPointMap.of(pixels, 80, 60).grey(image)
    maps = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
    np.testing.assert_array_equal(mapped, cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
    assert 0.01 < (mapped == 0).mean() < 0.3
