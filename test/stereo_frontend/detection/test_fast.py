# SPDX-License-Identifier: Apache-2.0
"""FAST corners on a picture whose corners are known, and descriptors that follow them to another picture."""

from __future__ import annotations

import cv2
import numpy as np

from stereo_frontend.detection.fast import FastDetector
from stereo_frontend.surf.surf import SurfConfig


def keep_all(uv, size, response):
    return np.arange(len(uv))


CORNERS = np.array([[62, 38], [103, 45], [97, 84], [55, 76]])


def quadrangle(contrast: int = 120) -> np.ndarray:
    image = np.full((120, 160), 80, np.uint8)
    return np.asarray(cv2.fillConvexPoly(image, CORNERS.astype(np.int32), 80 + contrast, cv2.LINE_AA))


def test_the_corners_of_a_quadrangle_are_found_and_nothing_else():
    found = FastDetector()(quadrangle(), 1.0, keep_all)
    distance = np.linalg.norm(found.uv[:, None] - CORNERS, axis=2)
    assert (distance.min(axis=0) <= 2.0).all()
    assert (distance.min(axis=1) <= 3.0).all()


def test_a_corner_is_described_alike_where_it_has_moved(rng):
    scene = rng.integers(60, 120, (140, 200), dtype=np.uint8)
    scene[40:70, 60:100] = 220
    here, there = (FastDetector(SurfConfig(upright=True))(scene[:120, k : k + 160], 4.0, keep_all) for k in (0, 17))
    near = np.linalg.norm(here.uv[:, None] - [17, 0] - there.uv, axis=2)
    i, j = np.nonzero(near == 0.0)
    assert len(i) >= 4
    np.testing.assert_allclose((here.descriptors[i] * there.descriptors[j]).sum(axis=1), 1.0, atol=1e-5)


def test_weak_corners_are_below_the_threshold_and_descriptors_as_surf_is_told():
    assert len(FastDetector()(quadrangle(15), 1.0, keep_all)) == 0
    assert FastDetector(SurfConfig(extended=False))(quadrangle(), 1.0, keep_all).descriptors.shape[1] == 64
