# SPDX-License-Identifier: Apache-2.0
"""ToF depth seen from the left camera: parallax, gate, variances, stamps."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.geometry import invert_transform, make_transform, so3_exp, transform_points
from slam_core.types import DepthImage
from stereo_frontend.depth.depth_fusion import MappedDepth, fuse_depth, map_depth

LEFT = Camera(640, 480, 283.0, 283.0, 320.0, 240.0)
TOF = Camera(204, 204, 280.0, 280.0, 101.5, 101.5)
T_LEFT_TOF = make_transform(so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.01, 0.06, 0.005]))
NORMAL, DISTANCE = np.array([0.3, 0.1, 1.0]), 1.5


def tof_image_of_the_plane(sigma: float = 0.004) -> DepthImage:
    """The plane ``NORMAL . p = DISTANCE`` of the left frame, as the ToF camera sees it."""
    v, u = np.mgrid[:204, :204].astype(float)
    rays = TOF.unproject(np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    n = T_LEFT_TOF[:3, :3].T @ NORMAL
    depth = ((DISTANCE - NORMAL @ T_LEFT_TOF[:3, 3]) / (rays @ n)).reshape(204, 204).astype(np.float32)
    return DepthImage(0, depth, np.full_like(depth, sigma), TOF)


def left_points(rng, n=300):
    uv = rng.uniform([260, 190], [380, 280], (n, 2))
    rays = LEFT.unproject(uv, np.ones(n))
    return uv, DISTANCE / (rays @ NORMAL)


@pytest.mark.parametrize("offset", [0.0, 0.5, -0.6, np.nan])
def test_parallax_is_solved_whatever_the_first_guess(rng, offset):
    uv, truth = left_points(rng)
    mapped = map_depth(uv, truth + offset, LEFT, tof_image_of_the_plane(), T_LEFT_TOF)
    assert np.isfinite(mapped.depth).mean() > 0.95
    ok = np.isfinite(mapped.depth)
    np.testing.assert_allclose(mapped.depth[ok], truth[ok], atol=0.002)
    points = LEFT.unproject(uv, truth)
    expected = TOF.project(transform_points(invert_transform(T_LEFT_TOF), points))
    assert np.abs(mapped.uv[ok] - expected[ok]).max() < 0.1


def test_pixels_outside_the_tof_image_have_no_depth(rng):
    uv = np.array([[5.0, 5.0], [630.0, 470.0]])
    mapped = map_depth(uv, np.array([1.5, 1.5]), LEFT, tof_image_of_the_plane(), T_LEFT_TOF)
    assert np.isnan(mapped.depth).all()


def test_an_empty_depth_image_gives_nothing(rng):
    uv, truth = left_points(rng, 5)
    empty = DepthImage(0, np.full((204, 204), np.nan, np.float32), np.full((204, 204), np.nan, np.float32), TOF)
    assert np.isnan(map_depth(uv, truth, LEFT, empty, T_LEFT_TOF).depth).all()


def test_age_grows_the_sigma(rng):
    uv, truth = left_points(rng)
    sigma = [
        np.nanmedian(map_depth(uv, truth, LEFT, tof_image_of_the_plane(), T_LEFT_TOF, age).sigma)
        for age in (0.0, 0.02, 0.05)
    ]
    assert sigma[0] < sigma[1] < sigma[2]
    assert sigma[2] > 0.3 * 0.05


def test_fused_depth_is_better_than_both_and_its_sigma_true(rng):
    n, truth = 20000, 2.0
    sigma_stereo, sigma_tof = rng.uniform(0.01, 0.05, (2, n))
    stereo, tof = truth + sigma_stereo * rng.normal(size=n), truth + sigma_tof * rng.normal(size=n)
    depth, sigma, fused = fuse_depth(
        stereo, sigma_stereo, MappedDepth(tof, sigma_tof, np.zeros((n, 2)), np.ones(n)), 9.0
    )
    assert fused.mean() == pytest.approx(0.9973, abs=0.002)
    assert np.std(depth - truth) < 0.9 * min(np.std(stereo - truth), np.std(tof - truth))
    assert 0.97 < np.std((depth - truth)[fused] / sigma[fused]) < 1.03


def test_a_tof_depth_that_disagrees_is_left_out():
    tof = MappedDepth(np.array([2.5, np.nan, 2.01]), np.array([0.01, np.nan, 0.01]), np.zeros((3, 2)), np.ones(3))
    depth, sigma, fused = fuse_depth(np.array([2.0, 2.0, np.nan]), np.array([0.02, 0.02, np.nan]), tof, 9.0)
    assert not fused.any()
    np.testing.assert_array_equal(depth, [2.0, 2.0, np.nan])
    np.testing.assert_array_equal(sigma, [0.02, 0.02, np.nan])
