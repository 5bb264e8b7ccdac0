# SPDX-License-Identifier: Apache-2.0
"""Kernels of the patch alignment against plain NumPy and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from stereo_frontend.stereo.patch_alignment import _sample_patch, _take_template, _template_sums


@pytest.fixture
def image(rng):
    return rng.integers(0, 256, (60, 90), dtype=np.uint8)


def layout(radius):
    """Mask, columns and rows (from the middle) of the padded patch, flat."""
    side = 2 * radius + 1
    stride = 16 * ((side + 15) // 16)
    rows, columns = np.mgrid[:side, :stride].astype(np.float32) - radius
    return (columns <= radius).astype(np.float32).ravel(), columns.ravel(), rows.ravel(), side, stride


@pytest.mark.parametrize("radius", [5, 7, 9])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.04, -0.1), (-0.2, 0.15), (0.4, 0.0)])
def test_samples_are_bilinear(image, radius, slopes, rng):
    inside, columns, rows, side, stride = layout(radius)
    for u_right in (3.0 + radius, 40.3, 85.0 - radius):
        u, v, u_right = np.float32(31.2), np.float32(28.7), np.float32(u_right)
        p, row_offset, patch = np.array([0.31, -0.2, *slopes]), np.float32(0.4), np.zeros(side * stride, np.float32)
        du, dv = np.round(u) + columns - u, np.round(v) + rows - v
        at = np.array([v + dv + row_offset + p[1], u_right + p[0] + (1 + p[2]) * du + p[3] * dv])[:, inside > 0]
        fits = at[1].min() >= 0 and at[1].max() < image.shape[1] - 1
        room = np.zeros(2 * stride, np.float32)
        arguments = u, v, u_right, row_offset, p, radius, np.float32(100.0), inside, room, patch
        assert _sample_patch(image, *arguments) == fits
        if fits:
            expected = map_coordinates(image.astype(float), at, order=1) - 100.0
            np.testing.assert_allclose(patch[inside > 0], expected, atol=2e-3)
            assert not patch[inside == 0].any()


@pytest.mark.parametrize("radius", [5, 7, 9])
def test_template_sums_are_those_of_numpy(image, radius):
    inside, columns, rows, side, stride = layout(radius)
    template, J = np.zeros(side * stride, np.float32), np.zeros((4, side * stride), np.float32)
    window = np.zeros((side + 2, stride + 16), np.float32)
    u, v, n = np.float32(90 - radius - 2.2), np.float32(60 - radius - 1.8), side * side  # at the corner
    assert _take_template(image, u, v, radius, inside, columns, rows, window, template, J)
    hessian, projected, mean = np.zeros((4, 4)), np.zeros(4), np.zeros(5)
    energy = _template_sums(template, J, n, hessian, projected, mean)
    v0, u0 = round(float(v)), round(float(u))
    part = image.astype(float)[v0 - radius - 1 : v0 + radius + 2, u0 - radius - 1 : u0 + radius + 2]
    gv, gu = (g[1:-1, 1:-1].ravel() for g in np.gradient(part))
    y, x = (g.ravel() for g in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    expected = np.stack([gu, gv, gu * (u0 + x - u), gu * (v0 + y - v)])
    centred = expected - expected.mean(axis=1, keepdims=True)
    t = part[1:-1, 1:-1].ravel() - part[1:-1, 1:-1].mean()
    np.testing.assert_allclose(hessian, centred @ centred.T, rtol=1e-4, atol=1e-4 * np.abs(hessian).max())
    np.testing.assert_allclose(projected, centred @ t, rtol=1e-3, atol=1e-5 * np.abs(hessian).max())
    np.testing.assert_allclose(mean[:4], expected.mean(axis=1), atol=1e-3)
    assert energy == pytest.approx(t @ t, rel=1e-5)


def test_at_the_border_there_is_no_template(image):
    inside, columns, rows, side, stride = layout(7)
    room = np.zeros((side + 2, stride + 16), np.float32), np.zeros(side * stride, np.float32)
    J = np.zeros((4, side * stride), np.float32)
    for u, v in ((7.2, 30.0), (81.6, 30.0), (40.0, 7.2), (40.0, 51.6)):
        assert not _take_template(image, np.float32(u), np.float32(v), 7, inside, columns, rows, *room, J)
