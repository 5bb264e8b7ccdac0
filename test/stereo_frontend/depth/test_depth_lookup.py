# SPDX-License-Identifier: Apache-2.0
"""Depth between pixels: exact on planes, refused at edges, honest about noise."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.types import DepthImage
from stereo_frontend.depth.depth_lookup import has_depth, sample_depth

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


def plane_twin(image: DepthImage, u: float, v: float) -> tuple[float, float, float] | None:
    """Depth and gradient of the plane of inverse depth, by least squares; None where there is no single surface."""
    u0, v0 = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    if not (1 <= u0 < CAMERA.width - 1 and 1 <= v0 < CAMERA.height - 1):
        return None
    part = (slice(v0 - 1, v0 + 2), slice(u0 - 1, u0 + 2))
    depth, sigma = (np.asarray(values[part], np.float64).ravel() for values in (image.depth, image.sigma))
    if not (np.isfinite(depth).all() and np.isfinite(sigma).all()):
        return None
    dv, du = (g.ravel() for g in np.mgrid[-1:2, -1:2])
    plane, *_ = np.linalg.lstsq(np.column_stack([np.ones(9), du, dv]), 1.0 / depth, rcond=None)
    z = 1.0 / (plane @ [1.0, u - u0, v - v0])
    gradient = -plane[1:] * z**2
    step = np.abs(1.0 / depth - plane @ [np.ones(9), du, dv]) * z**2
    fits = (step <= np.maximum(4.0 * sigma, 0.005 * z)).all() and (np.abs(gradient) <= 0.06 * z).all()
    return (z, *gradient) if fits and 0.9 * depth.min() <= z <= 1.1 * depth.max() else None


def test_the_kernel_against_its_twin(rng):
    depth = slanted() + rng.normal(0, 0.02, (204, 204)) + 0.5 * (np.arange(204) > 100)
    depth[rng.random(depth.shape) < 0.01] = np.nan
    image = depth_image(depth, sigma=0.01)
    uv = rng.uniform(-2, 206, (600, 2))
    samples = sample_depth(image, uv)
    expected = [plane_twin(image, *position) for position in uv]
    known = np.array([plane is not None for plane in expected])
    np.testing.assert_array_equal(np.isfinite(samples.depth), known)
    np.testing.assert_array_equal(has_depth(image, uv), known)
    assert 200 < known.sum() < 590
    found = np.column_stack([samples.depth, samples.gradient])[known]
    np.testing.assert_allclose(found, [plane for plane in expected if plane], rtol=1e-9, atol=1e-12)


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
