# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ndt_registration.keyframe_window import ScanPoints


def test_of_a_large_depth_image_only_some_columns_are_taken_however_it_comes(rng: np.random.Generator) -> None:
    picture = rng.normal(size=(400, 801, 3)).astype(np.float32)
    picture[rng.random((400, 801)) < 0.1, 2] = np.nan
    kept = picture[:, ::3].reshape(-1, 3)
    kept = kept[np.isfinite(kept).all(axis=1)]
    np.testing.assert_array_equal(ScanPoints.of(picture).points, kept)
    np.testing.assert_array_equal(ScanPoints.of(picture.reshape(-1, 3)).points, kept)


def test_small_images_and_plane_scans_are_taken_whole(rng: np.random.Generator) -> None:
    points = rng.normal(size=(300, 400, 3))
    np.testing.assert_array_equal(ScanPoints.of(points).points, points.reshape(-1, 3))
    assert len(ScanPoints.of(np.empty((0, 3))).points) == 0
    planar = ScanPoints.of(points[:5, :100, :2])
    assert planar.planar
    np.testing.assert_array_equal(planar.points[:, :2], points[:5, :100, :2].reshape(-1, 2))
