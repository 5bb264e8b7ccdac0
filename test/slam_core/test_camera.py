# SPDX-License-Identifier: Apache-2.0
"""Camera models against OpenCV's projection, and the exact inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.geometry import so3_exp

CAMERAS = {
    "none": Camera(640, 480, 520.0, 525.0, 318.5, 242.0),
    "plumb_bob": Camera(752, 480, 458.654, 457.296, 367.2, 248.4, "plumb_bob", (-0.2834, 0.074, 0.0002, 1.8e-5, 0.0)),
    "plumb_bob_4": Camera(204, 204, 280.0, 281.0, 101.0, 102.0, "plumb_bob", (-0.38, 0.19, 0.001, -0.002)),
    "rational_polynomial": Camera(
        640,
        480,
        300.0,
        301.0,
        320.0,
        240.0,
        "rational_polynomial",
        (0.35, 0.05, 0.001, -0.0005, 0.002, 0.55, 0.12, 0.006),
    ),
    "equidistant": Camera(848, 800, 285.0, 286.0, 420.0, 398.0, "equidistant", (-0.008, 0.045, -0.043, 0.0085)),
    "equidistant_zero": Camera(848, 800, 285.0, 286.0, 420.0, 398.0, "equidistant", (0.0, 0.0, 0.0, 0.0)),
}


def opencv_projection(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    zero, D = np.zeros(3), np.array(camera.distortion, dtype=np.float64)
    if camera.distortion_model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, D)
    else:
        pixels, _ = cv2.projectPoints(points[:, None], zero, zero, camera.K, D if len(D) else None)
    return np.asarray(pixels).reshape(-1, 2)


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_agrees_with_opencv(name: str, rng: np.random.Generator) -> None:
    camera = CAMERAS[name]
    points = np.column_stack([rng.uniform(-0.6, 0.6, (500, 2)), np.ones(500)]) * rng.uniform(0.5, 8.0, (500, 1))
    np.testing.assert_allclose(camera.project(points), opencv_projection(camera, points), atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_unprojection_inverts_projection_over_the_image(name: str) -> None:
    camera = CAMERAS[name]
    v, u = np.mgrid[0 : camera.height : 16, 0 : camera.width : 16]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    if camera.distortion_model == "equidistant":  # the image plane x/z, y/z ends before 90 degrees off the axis
        pixels = pixels[np.linalg.norm(pixels - [camera.cx, camera.cy], axis=1) < 1.35 * camera.fx]
    depth = np.linspace(0.5, 9.0, len(pixels))
    points = camera.unproject(pixels, depth)
    np.testing.assert_allclose(points[:, 2], depth)
    np.testing.assert_allclose(camera.project(points), pixels, atol=1e-7)


def test_a_fisheye_without_coefficients_is_still_a_fisheye() -> None:
    assert not CAMERAS["equidistant_zero"].is_rectified
    assert CAMERAS["none"].is_rectified
    assert Camera(640, 480, 500.0, 500.0, 320.0, 240.0, "plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)).is_rectified


def test_pixels_the_lens_cannot_make_have_no_ray() -> None:
    """Beyond the turning point of the radial polynomial no ray maps to the pixel: NaN, not a made-up ray."""
    camera = Camera(1000, 1000, 200.0, 200.0, 500.0, 500.0, "plumb_bob", (-0.3, 0.0, 0.0, 0.0, 0.0))
    xy = camera.normalised_from_pixels(np.array([[500.0, 500.0], [550.0, 520.0], [0.0, 0.0], [999.0, 500.0]]))
    assert np.isfinite(xy[:2]).all()
    assert np.isnan(xy[2:]).all()


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = CAMERAS["none"].project(np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], [318.5, 242.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "size"),
        ({"fx": 0.0}, "calibrated"),
        ({"fy": float("nan")}, "calibrated"),
        ({"distortion_model": "thin_prism"}, "plumb_bob"),
        ({"distortion_model": "plumb_bob", "distortion": (float("inf"), 0.0, 0.0, 0.0)}, "finite"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object], message: str) -> None:
    good: dict[str, object] = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    with pytest.raises(ValueError, match=message):
        Camera(**{**good, **change})  # type: ignore[arg-type]


def test_stereo_depth_and_swapped_cameras() -> None:
    stereo = StereoCamera(CAMERAS["none"], 0.12)
    np.testing.assert_allclose(stereo.depth_from_disparity(np.array([62.4, 31.2])), [1.0, 2.0])
    with pytest.raises(ValueError, match="swapped"):
        StereoCamera(CAMERAS["none"], -0.12)
    with pytest.raises(ValueError, match="rectified"):
        StereoCamera(CAMERAS["plumb_bob"], 0.12)


def test_camera_info_reads_projection_and_baseline() -> None:
    P = np.array([[500.0, 0, 320, -60.0], [0, 500, 240, 0], [0, 0, 1, 0]])
    info = CameraInfo(CAMERAS["plumb_bob"], so3_exp(np.array([0.0, 0.01, 0.0])), P)
    assert info.baseline == pytest.approx(0.12)
    assert (info.rectified.fx, info.rectified.cx, info.rectified.is_rectified) == (500.0, 320.0, True)
    assert not info.is_rectified


def test_camera_info_of_zeros_means_the_raw_camera() -> None:
    info = CameraInfo(CAMERAS["none"], np.zeros((3, 3)), np.zeros((3, 4)))
    np.testing.assert_array_equal(info.P[:, :3], CAMERAS["none"].K)
    assert info.is_rectified
    with pytest.raises(ValueError, match="no rotation"):
        CameraInfo(CAMERAS["none"], 2.0 * np.eye(3))
