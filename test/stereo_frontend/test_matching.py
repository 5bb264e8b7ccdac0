"""Stereo matching of constructed keypoints."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_frontend.keypoints import Keypoints
from stereo_frontend.matching import MatchingConfig, disparity_bounds, match_stereo, mutual_best, swapped_share

BOUNDS = (0.5, 60.0)


def keypoints(uv: np.ndarray, descriptors: np.ndarray, size: float = 10.0) -> Keypoints:
    n = len(uv)
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Keypoints(
        uv.astype(np.float32), np.full(n, size, np.float32), np.ones(n, np.float32), unit.astype(np.float32)
    )


@pytest.fixture
def pair(rng):
    uv = rng.uniform([100, 20], [300, 220], (80, 2))
    descriptors = rng.normal(size=(80, 128))
    disparity = rng.uniform(2, 50, 80)
    shuffled = rng.permutation(80)
    right = (uv - np.column_stack([disparity, rng.normal(0, 0.3, 80)]))[shuffled]
    noisy = (descriptors + 0.2 * rng.normal(size=descriptors.shape))[shuffled]
    return keypoints(uv, descriptors), keypoints(right, noisy), np.argsort(shuffled)


def test_all_partners_are_found(pair):
    left, right, partner = pair
    matches = match_stereo(left, right, MatchingConfig(), BOUNDS)
    np.testing.assert_array_equal(matches.left, np.arange(80))
    np.testing.assert_array_equal(matches.right, partner)
    assert np.all(matches.similarity > 0.9)


def test_partners_off_the_row_or_beyond_the_disparities_are_not(pair):
    left, right, partner = pair
    right.uv[partner[0], 1] += 5.0
    right.uv[partner[1], 0] = left.uv[1, 0] + 3.0
    right.uv[partner[2], 0] = left.uv[2, 0] - 70.0
    right.size[partner[3]] = 25.0
    matches = match_stereo(left, right, MatchingConfig(), BOUNDS)
    assert set(range(80)) - set(matches.left.tolist()) == {0, 1, 2, 3}


def test_a_match_must_be_the_best_of_both_sides_and_clear():
    similarity = np.array([[0.9, 0.2, 0.1], [0.95, 0.3, 0.1], [0.1, 0.80, 0.79]], np.float32)
    matches = mutual_best(similarity, 0.7, 0.9)
    assert list(zip(matches.left, matches.right, strict=True)) == [(1, 0)]
    assert list(mutual_best(similarity, 0.7, 1.0).left) == [1, 2]
    assert len(mutual_best(similarity, 0.96, 1.0)) == 0


def test_swapped_images_show_in_the_sign_of_the_disparity(pair):
    left, right, _ = pair
    assert swapped_share(left, right, MatchingConfig(), BOUNDS) == (0.0, 80)
    assert swapped_share(right, left, MatchingConfig(), BOUNDS) == (1.0, 80)


def test_no_keypoints_no_matches(pair):
    assert len(match_stereo(pair[0], Keypoints.none(), MatchingConfig(), BOUNDS)) == 0


def test_disparity_bounds_follow_the_depths():
    assert disparity_bounds(MatchingConfig(min_depth=0.5, max_depth=50.0), 34.0) == (
        pytest.approx(0.68),
        pytest.approx(68.0),
    )
