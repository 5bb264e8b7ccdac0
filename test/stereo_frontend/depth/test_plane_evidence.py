# SPDX-License-Identifier: Apache-2.0
"""The bend of a depth camera's depth is found from walls alone; a straight camera is left as it is."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.types import DepthImage
from stereo_frontend.depth.plane_evidence import DistortionEstimate, PlaneEvidence

CAMERA = Camera(160, 120, 146.0, 146.0, 80.0, 60.0)
IMAGES = 24


def corner(rng: np.random.Generator, columns: float, rows: float) -> DepthImage:
    """Two walls and a floor at random slants, measured by a camera bent by that much."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    turn = rng.uniform(0.2, 0.8, 2)
    walls = [(turn[0], 0.05, 1.0, rng.uniform(2.0, 3.0)), (-turn[1], -0.05, 1.0, rng.uniform(2.0, 3.0))]
    surfaces = [d / (a * x + b * y + c) for a, b, c, d in walls] + [np.where(y > 0.05, 1.0 / np.maximum(y, 0.05), 9.0)]
    true = np.min([np.where(z > 0.0, z, 9.0) for z in surfaces], axis=0)
    sigma = 0.001425 * true**2 + 0.0012
    factor = 1.0 + columns * (x**2 - np.mean(x**2)) + rows * (y**2 - np.mean(y**2))
    measured = true / factor + rng.normal(0.0, sigma)
    return DepthImage(0, measured.astype(np.float32), sigma.astype(np.float32), CAMERA)


def estimated(images: list[DepthImage]) -> DistortionEstimate:
    evidence = PlaneEvidence(np.random.default_rng(1))
    for image in images:
        evidence.add(image)
    return evidence.estimate()


@pytest.mark.parametrize("true", [(0.03, 0.0), (-0.04, 0.05)])
def test_a_bent_depth_is_found_within_its_uncertainty(rng: np.random.Generator, true: tuple[float, float]) -> None:
    found = estimated([corner(rng, *true) for _ in range(IMAGES)])
    np.testing.assert_array_equal(found.is_corrected, np.array(true) != 0.0)
    assert (np.abs(found.measured - true) < 3.0 * found.sigma).all()
    assert (np.abs(found.values - true) < 3.0 * found.sigma).all()
    assert (found.sigma < 0.005).all()


def test_a_straight_camera_is_left_alone(rng: np.random.Generator) -> None:
    found = estimated([corner(rng, 0.0, 0.0) for _ in range(IMAGES)])
    assert found.is_observable.all()
    assert not found.is_corrected.any()
    assert not found.values.any()


def test_what_one_half_of_the_recording_does_not_confirm_is_not_believed(rng: np.random.Generator) -> None:
    images = [corner(rng, 0.06, 0.0) for _ in range(IMAGES)] + [corner(rng, 0.02, 0.0) for _ in range(IMAGES)]
    assert estimated(images[:IMAGES]).is_corrected[0]
    found = estimated(images)
    assert found.measured[0] ** 2 > 36.0 * found.sigma[0] ** 2
    assert not found.is_corrected.any()


def test_few_walls_or_none_are_said_to_show_nothing(rng: np.random.Generator) -> None:
    few = estimated([corner(rng, 0.05, 0.05) for _ in range(2)])
    blank = np.full((CAMERA.height, CAMERA.width), np.nan, np.float32)
    none = estimated([DepthImage(0, blank, blank, CAMERA)])
    for found in (few, none):
        assert not found.is_observable.any()
        assert not found.values.any()
    assert none.planes == 0
    assert np.isfinite(none.sigma).all()
