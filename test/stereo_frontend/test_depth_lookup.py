# SPDX-License-Identifier: Apache-2.0
"""Depth between pixels: exact on planes, refused at edges, honest about noise."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.types import DepthImage
from stereo_frontend.depth_lookup import sample_depth

CAMERA = Camera(204, 204, 280.0, 280.0, 101.5, 101.5)
NORMAL = (0.5, -0.2, 1.0)
HALF_PIXEL = np.array([0.5, 0.0])


def plane_depth(uv: np.ndarray, normal: tuple[float, float, float], distance: float) -> np.ndarray:
    rays = CAMERA.unproject(uv, np.ones(len(uv)))
    return distance / (rays @ np.asarray(normal))


def depth_image(depth: np.ndarray, sigma: float = 0.003) -> DepthImage:
    return DepthImage(0, depth.astype(np.float32), np.full_like(depth, sigma, np.float32), CAMERA)


def slanted(normal=NORMAL, distance=2.0) -> np.ndarray:
    v, u = np.mgrid[:204, :204].astype(float)
    return plane_depth(np.column_stack([u.ravel(), v.ravel()]), normal, distance).reshape(204, 204)


def test_a_slanted_plane_is_exact_between_pixels(rng):
    uv = rng.uniform(2, 200, (300, 2))
    samples = sample_depth(depth_image(slanted()), uv)
    np.testing.assert_allclose(samples.depth, plane_depth(uv, NORMAL, 2.0), rtol=1e-4)
    numeric = plane_depth(uv + HALF_PIXEL, NORMAL, 2.0) - plane_depth(uv - HALF_PIXEL, NORMAL, 2.0)
    np.testing.assert_allclose(samples.gradient[:, 0], numeric, rtol=0.02)


def test_sigma_is_that_of_the_interpolated_noise(rng):
    truth = slanted()
    noisy = depth_image(truth + rng.normal(0, 0.01, truth.shape), sigma=0.01)
    uv = rng.uniform(2, 200, (4000, 2))
    samples = sample_depth(noisy, uv)
    error = samples.depth - plane_depth(uv, NORMAL, 2.0)
    assert np.isfinite(error).mean() > 0.98
    assert 0.95 < np.nanstd(error / samples.sigma) < 1.05


def test_no_depth_is_invented_at_an_edge(rng):
    depth = np.full((204, 204), 2.0)
    depth[:, 100:] = 2.2
    uv = np.column_stack([rng.uniform(95, 105, 400), rng.uniform(20, 180, 400)])
    samples = sample_depth(depth_image(depth), uv)
    found = samples.depth[np.isfinite(samples.depth)]
    assert np.all((np.abs(found - 2.0) < 1e-3) | (np.abs(found - 2.2) < 1e-3))
    beside = np.abs(uv[:, 0] - 99.5) < 0.9
    assert np.isnan(samples.depth[beside]).all()
    assert np.isfinite(samples.depth[np.abs(uv[:, 0] - 99.5) > 3]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_missing_pixels_and_positions_outside_have_no_depth(bad):
    depth = slanted()
    depth[50, 60] = bad
    image = depth_image(depth)
    uv = [[60.4, 50.2], [61.2, 51.0], [-3.0, 10.0], [203.4, 10.0], [np.nan, 5.0], [100.0, 1e9], [100.0, 100.0]]
    samples = sample_depth(image, uv)
    assert np.isnan(samples.depth[:6]).all()
    assert np.isfinite(samples.depth[6])
