# SPDX-License-Identifier: Apache-2.0
"""Rectification: rows are epipolar lines, disparity gives depth, and the same geometry as OpenCV's stereoRectify."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam_calibration.rectification import stereo_infos
from slam_core.camera import Camera, CameraInfo
from slam_core.geometry import make_transform, so3_exp, transform_points
from slam_simulation.calibration.board_views import beside, example_camera

T_RIGHT_LEFT = beside(0.12, 0.002, (0.01, -0.03, 0.008))


def rectified_pixels(info: CameraInfo, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rectified pixels of points in a raw optical frame."""
    return info.rectified.project(points @ info.R.T)


@pytest.mark.parametrize("lens", ["none", "plumb_bob", "rational_polynomial", "equidistant"])
def test_rows_agree_and_disparity_gives_depth(lens: str, rng: np.random.Generator) -> None:
    camera = example_camera(lens).camera
    left, right = stereo_infos(camera, camera, T_RIGHT_LEFT)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), np.ones(200)]) * rng.uniform(0.5, 9.0, (200, 1))
    in_left, in_right = rectified_pixels(left, points), rectified_pixels(right, transform_points(T_RIGHT_LEFT, points))
    np.testing.assert_allclose(in_left[:, 1], in_right[:, 1], atol=1e-9)
    depth = left.P[0, 0] * right.baseline / (in_left[:, 0] - in_right[:, 0])
    np.testing.assert_allclose(depth, (points @ left.R.T)[:, 2], rtol=1e-9)
    assert right.baseline == pytest.approx(np.linalg.norm(T_RIGHT_LEFT[:3, 3]))
    assert left.baseline == 0.0


@pytest.mark.parametrize("lens", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_every_rectified_pixel_comes_from_inside_the_raw_images(lens: str) -> None:
    camera = example_camera(lens).camera
    for info in stereo_infos(camera, camera, T_RIGHT_LEFT):
        v, u = np.mgrid[: camera.height : 10, : camera.width : 10]
        depthless = info.rectified.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        raw = camera.project(np.column_stack([depthless, np.ones(len(depthless))]) @ info.R)
        assert raw.min() > -1.0
        assert (raw < [camera.width, camera.height]).all()


def test_same_rotations_as_opencv() -> None:
    camera = example_camera("plumb_bob").camera
    T = T_RIGHT_LEFT
    D = np.array(camera.distortion)
    R1, R2, *_ = cv2.stereoRectify(camera.K, D, camera.K, D, (640, 480), T[:3, :3].copy(), T[:3, 3:].copy())
    left, right = stereo_infos(camera, camera, T)
    # Both turn x along the baseline; OpenCV splits the turn about it a little differently.
    for ours, theirs in ((left.R, R1), (right.R, R2)):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)
        assert np.degrees(np.arccos(min(ours[2] @ theirs[2], 1.0))) < 0.5


def test_swapped_and_unequal_cameras_are_named() -> None:
    camera = example_camera("none").camera
    with pytest.raises(ValueError, match="swapped"):
        stereo_infos(camera, camera, beside(-0.12, 0.0, (0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="640 x 480 and 320 x 240"):
        stereo_infos(camera, Camera(320, 240, 260.0, 260.0, 160.0, 120.0), T_RIGHT_LEFT)
    outward = so3_exp(np.array([0.0, -1.3, 0.0]))
    with pytest.raises(ValueError, match="too little in common"):
        stereo_infos(camera, camera, make_transform(outward, -outward @ [0.12, 0.0, 0.0]))
