# SPDX-License-Identifier: Apache-2.0
"""Sub-pixel disparity on textures whose shift is known exactly."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_frontend.stereo.disparity import DisparityConfig, refine_disparity


@pytest.fixture
def positions(rng):
    return rng.uniform([40, 15], [300, 225], (400, 2)).astype(np.float32)


def refine(pair, positions, start, **options):
    return refine_disparity(
        pair.left, pair.right, positions, positions[:, 0] - np.float32(start), DisparityConfig(**options)
    )


@pytest.mark.parametrize("disparity", [5.0, 12.37, 20.5])
def test_the_true_shift_is_found_from_a_pixel_away(stereo_pair, positions, disparity):
    refined = refine(stereo_pair(disparity, noise=1.0), positions, disparity + 1.0)
    error = refined.disparity[refined.valid] - disparity
    assert refined.valid.mean() > 0.95
    assert abs(np.median(error)) < 0.01
    assert np.median(np.abs(error)) < 0.05


def test_sigma_follows_the_noise(stereo_pair, positions):
    normalised = []
    for noise in (2.0, 6.0):
        refined = refine(stereo_pair(9.4, noise=noise), positions, 9.0, sigma_floor=0.001)
        assert refined.valid.mean() > 0.8
        normalised.append(((refined.disparity - 9.4) / refined.sigma)[refined.valid])
    for values in normalised:
        assert 0.75 < 1.4826 * np.median(np.abs(values)) < 1.3


def test_brightness_of_one_image_does_not_matter(stereo_pair, positions):
    refined = refine(stereo_pair(12.3, gain=0.6), positions, 12.0)
    assert refined.valid.mean() > 0.9
    assert abs(np.median(refined.disparity[refined.valid]) - 12.3) < 0.02


def test_an_error_of_rectification_does_not_leak_into_the_disparity(stereo_pair, positions):
    refined = refine(stereo_pair(12.3, row=0.4), positions, 12.0)
    error = refined.disparity[refined.valid] - 12.3
    rigid = refine(stereo_pair(12.3, row=0.4), positions, 12.0, row_sigma=0.01)
    assert np.std(error) < 0.6 * np.std(rigid.disparity[rigid.valid] - 12.3)
    assert np.median(refined.row_shift[refined.valid]) == pytest.approx(0.4, abs=0.15)


def test_wrong_partners_and_borders_are_refused(stereo_pair, positions):
    pair = stereo_pair()
    assert refine(pair, positions, 45.0).valid.mean() < 0.05
    corner = np.array([[2.0, 2.0], [318.0, 100.0], [160.0, 238.0]], np.float32)
    assert not refine(pair, corner, 0.0).valid.any()


def test_flat_patches_are_refused(positions):
    flat = np.full((240, 320), 90, np.uint8)
    refined = refine_disparity(flat, flat, positions, positions[:, 0], DisparityConfig())
    assert not refined.valid.any()


def test_sigma_knows_that_interpolated_images_share_their_noise(stereo_pair, positions):
    """Rectification averages neighbours: less residual, but not less error. Without the correlation sigma is half too
    small.
    """
    pair = stereo_pair(9.4, noise=6.0)
    left, right = (cv2.blur(image, (2, 2)) for image in (pair.left, pair.right))
    refined = refine_disparity(left, right, positions, positions[:, 0] - np.float32(9.0), DisparityConfig())
    error = ((refined.disparity - 9.4) / refined.sigma)[refined.valid]
    assert refined.valid.mean() > 0.8
    assert 0.7 < 1.4826 * np.median(np.abs(error)) < 1.3
