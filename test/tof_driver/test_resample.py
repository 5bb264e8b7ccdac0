# SPDX-License-Identifier: Apache-2.0
"""Rectification of depth: exact on planes, no mixture of surfaces, the variance of what was averaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam_core.camera import Camera
from tof_driver.resample import RectificationMap

LENS = Camera(204, 204, 280.0, 281.0, 102.3, 100.2, "plumb_bob", (-0.38, 0.2, 0.001, -0.0008, 0.0))
IDEAL = replace(LENS, distortion_model="none", distortion=())
SLOPE, MULTIPLE = 0.02, 4.0


def rays(camera: Camera) -> NDArray[np.float64]:
    v, u = np.mgrid[: camera.height, : camera.width]
    xy = camera.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    return np.column_stack([xy, np.ones(len(xy))])


def plane_depth(camera: Camera, normal: tuple[float, float, float], offset: float) -> NDArray[np.float32]:
    depth = offset / (rays(camera) @ np.array(normal))
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def resample(
    depth: NDArray[np.float32], sigma: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    sigma = np.full_like(depth, 0.003) if sigma is None else sigma
    return RectificationMap.between(LENS, IDEAL).depth(depth, sigma, SLOPE, MULTIPLE)


def test_a_plane_stays_the_plane() -> None:
    out, sigma = resample(plane_depth(LENS, (0.5, 0.3, -1.0), -2.0))
    expected = plane_depth(IDEAL, (0.5, 0.3, -1.0), -2.0)
    inside = np.isfinite(out)
    assert inside.mean() > 0.999
    np.testing.assert_allclose(out[inside], expected[inside], atol=2e-4)
    assert np.all(sigma[inside] <= 0.00301)
    assert np.all(sigma[inside] >= 0.00149)


def test_a_plane_with_holes_stays_the_plane(rng: np.random.Generator) -> None:
    depth = plane_depth(LENS, (0.5, 0.3, -1.0), -2.0)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    out, _ = resample(depth)
    expected = plane_depth(IDEAL, (0.5, 0.3, -1.0), -2.0)
    inside = np.isfinite(out)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(out[inside], expected[inside], atol=1e-3)


def test_foreground_and_background_never_mix() -> None:
    near, far = plane_depth(LENS, (0.0, 0.1, 1.0), 1.5), plane_depth(LENS, (0.0, 0.0, 1.0), 3.0)
    chessboard = (np.indices(near.shape) // 17).sum(axis=0) % 2
    out, _ = resample(np.where(chessboard == 1, near, far).astype(np.float32))
    near, far = plane_depth(IDEAL, (0.0, 0.1, 1.0), 1.5), plane_depth(IDEAL, (0.0, 0.0, 1.0), 3.0)
    error = np.fmin(np.abs(out - near), np.abs(out - far))
    assert np.isfinite(out).mean() > 0.75
    assert np.nanmax(error) < 1e-3


def test_sigma_is_the_spread_of_the_output(rng: np.random.Generator) -> None:
    depth = plane_depth(LENS, (0.2, 0.3, -1.0), -2.0)
    sigma = rng.uniform(0.002, 0.01, depth.shape).astype(np.float32)
    truth = plane_depth(IDEAL, (0.2, 0.3, -1.0), -2.0)
    errors = []
    for _ in range(5):
        noisy = (depth + sigma * rng.normal(size=depth.shape)).astype(np.float32)
        out, out_sigma = resample(noisy, sigma)
        errors.append(((out - truth) / out_sigma)[np.isfinite(out)])
    assert np.std(np.concatenate(errors)) == pytest.approx(1.0, abs=0.01)


def test_pictures_are_resampled_to_the_same_grid() -> None:
    x = rays(LENS)[:, 0].reshape(204, 204)
    picture = (1.0 + x).astype(np.float32)
    out = RectificationMap.between(LENS, IDEAL).image(picture)
    expected = 1.0 + rays(IDEAL)[:, 0].reshape(204, 204)
    np.testing.assert_allclose(out[8:-8, 8:-8], expected[8:-8, 8:-8], atol=1e-4)


def test_outside_the_lens_there_is_no_depth() -> None:
    wide = replace(IDEAL, fx=150.0, fy=150.0)
    depth = plane_depth(LENS, (0.0, 0.0, 1.0), 2.0)
    out, sigma = RectificationMap.between(LENS, wide).depth(depth, np.full_like(depth, 0.003), SLOPE, MULTIPLE)
    assert np.isnan(out[0, 0])
    assert np.isnan(sigma[0, 0])
    assert out[102, 102] == pytest.approx(2.0, abs=1e-4)
