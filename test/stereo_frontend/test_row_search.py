# SPDX-License-Identifier: Apache-2.0
"""Partners along the row: on a picture that is moved by known amounts, on flat ground and on what repeats."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_frontend.row_search import search_rows

BOUNDS = (0.5, 60.0)
HEIGHT, WIDTH = 120, 240


def picture(rng: np.random.Generator, width: int = WIDTH) -> np.ndarray:
    return cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, width)), (0, 0), 1.5).clip(0, 255)


def moved(image: np.ndarray, disparity: float, rows: float = 0.0) -> np.ndarray:
    """The right image of a wall of one disparity."""
    return cv2.warpAffine(image, np.array([[1.0, 0.0, -disparity], [0.0, 1.0, rows]]), (WIDTH, HEIGHT))


def keypoints(rng: np.random.Generator, n: int = 60) -> np.ndarray:
    return rng.uniform([90, 20], [WIDTH - 20, HEIGHT - 20], (n, 2)).astype(np.float32)


@pytest.mark.parametrize(("disparity", "rows"), [(7.0, 0.0), (23.4, 0.0), (41.7, 3.0)])
def test_partners_are_found_to_a_fraction_of_a_pixel(rng, disparity, rows):
    left, uv = picture(rng), keypoints(rng)
    right = 0.7 * moved(left, disparity, rows) + 30.0  # gain and offset do not matter
    found = search_rows(left.astype(np.uint8), right.astype(np.uint8), uv, np.full(60, rows, np.float32), BOUNDS)
    assert np.isfinite(found).mean() > 0.95
    np.testing.assert_allclose(np.nanmedian(np.abs(uv[:, 0] - found - disparity)), 0.0, atol=0.1)
    assert np.nanmax(np.abs(uv[:, 0] - found - disparity)) < 0.5


def test_what_lies_beyond_the_bounds_or_repeats_or_is_flat_has_no_partner(rng):
    left, uv, level = picture(rng), keypoints(rng), np.zeros(60, np.float32)
    far = search_rows(left.astype(np.uint8), moved(left, 70.0).astype(np.uint8), uv, level, BOUNDS)
    assert np.isnan(far).mean() > 0.95
    stripes = np.tile(picture(rng, 20), (1, WIDTH // 20)).astype(np.uint8)
    assert np.isnan(search_rows(stripes, stripes, uv, level, BOUNDS)).all()
    flat = np.full((HEIGHT, WIDTH), 128, np.uint8)
    assert np.isnan(search_rows(flat, flat, uv, level, BOUNDS)).all()


def test_repeats_and_likeness_are_judged_in_noise_too(rng):
    uv, level = keypoints(rng), np.zeros(60, np.float32)
    stripes = np.tile(picture(rng, 20), (1, WIDTH // 20))
    pair = [(stripes + rng.normal(0, 4, stripes.shape)).clip(0, 255).astype(np.uint8) for _ in range(2)]
    assert np.isnan(search_rows(*pair, uv, level, BOUNDS)).mean() > 0.95
    left = picture(rng)
    spoilt = (moved(left, 20.0) + rng.normal(0, 13, left.shape)).clip(0, 255).astype(np.uint8)
    assert np.isnan(search_rows(left.astype(np.uint8), spoilt, uv, level, BOUNDS)).mean() > 0.95


def test_keypoints_at_the_edges_have_no_partner(rng):
    image = picture(rng).astype(np.uint8)
    corners = np.array([[1, 60], [WIDTH - 2, 60], [120, 1], [120, HEIGHT - 2], [9, 60]], np.float32)
    assert np.isnan(search_rows(image, image, corners, np.zeros(5, np.float32), (20.0, 60.0))).all()
