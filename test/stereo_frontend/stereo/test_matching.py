# SPDX-License-Identifier: Apache-2.0
"""Stereo matching of constructed keypoints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stereo_frontend.keypoints import Keypoints
from stereo_frontend.stereo.matching import (
    MAX_SIZE_RATIO,
    MatchingConfig,
    disparity_bounds,
    has_consistent_neighbour,
    is_distinct,
    match_stereo,
    swapped_share,
)

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


def test_descriptors_that_resemble_each_other_are_not_distinct(rng):
    descriptors = rng.normal(size=(6, 128)).astype(np.float32)
    descriptors[4] = descriptors[1] + 0.1 * descriptors[0]
    descriptors /= np.linalg.norm(descriptors, axis=1)[:, None]
    np.testing.assert_array_equal(is_distinct(descriptors, 0.97), [True, False, True, True, False, True])
    assert is_distinct(descriptors, 0.999).all()
    assert is_distinct(descriptors[:1], 0.97).all()
    assert is_distinct(descriptors[:0], 0.97).shape == (0,)


def test_partners_off_the_row_or_beyond_the_disparities_are_not(pair):
    left, right, partner = pair
    right.uv[partner[0], 1] += 5.0
    right.uv[partner[1], 0] = left.uv[1, 0] + 3.0
    right.uv[partner[2], 0] = left.uv[2, 0] - 70.0
    right.size[partner[3]] = 25.0
    matches = match_stereo(left, right, MatchingConfig(), BOUNDS)
    assert set(range(80)) - set(matches.left.tolist()) == {0, 1, 2, 3}


def twin(left, right, config, bounds):
    """The same by one matrix product over all pairs."""
    disparity = left.uv[:, None, 0] - right.uv[None, :, 0]
    allowed = (np.abs(left.uv[:, None, 1] - right.uv[None, :, 1]) <= config.epipolar_band) & (disparity >= bounds[0])
    allowed &= (disparity <= bounds[1]) & (
        np.abs(np.log(left.size[:, None] / right.size[None])) <= np.log(MAX_SIZE_RATIO)
    )
    similarity = np.where(allowed, left.descriptors @ right.descriptors.T, -2.0)
    best = similarity.argmax(axis=1)
    rows = np.arange(len(best))
    value, second = similarity[rows, best], np.sort(similarity, axis=1)[:, -2]
    keep = (value >= config.min_similarity) & (similarity.argmax(axis=0)[best] == rows)
    keep &= (1 - value) <= config.max_ratio**2 * (1 - second)
    return rows[keep], best[keep]


@pytest.mark.parametrize("ratio", [0.9, 1.0])
def test_crowded_keypoints_match_as_by_the_full_matrix_product(rng, ratio):
    """Few prototypes and much noise: every rule decides some pairs."""
    prototypes = rng.normal(size=(6, 32))
    sides = []
    for _ in range(2):
        uv = rng.uniform([0, 0], [120, 40], (300, 2))
        descriptors = prototypes[rng.integers(0, 6, 300)] + 0.35 * rng.normal(size=(300, 32))
        sides.append(keypoints(uv, descriptors))
        sides[-1].size[:] = rng.uniform(8, 16, 300)
    config = MatchingConfig(max_ratio=ratio, min_similarity=0.85)
    matches = match_stereo(*sides, config, BOUNDS)
    left, right = twin(*sides, config, BOUNDS)
    assert len(left) > 20
    np.testing.assert_array_equal(matches.left, left)
    np.testing.assert_array_equal(matches.right, right)


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


def test_a_match_that_slipped_by_a_repeat_stands_alone(rng):
    uv = rng.uniform([0, 0], [600, 400], (200, 2)).astype(np.float32)
    disparity = 8.0 + uv[:, 0] / 300.0
    disparity[[3, 70]] = 31.0
    disparity[5] = np.nan
    alone = ~has_consistent_neighbour(uv, disparity, 16)
    assert set(np.flatnonzero(alone)) == {3, 5, 70}
    assert set(np.flatnonzero(~has_consistent_neighbour(uv, disparity, 0))) == {5}


def test_neighbours_are_those_of_a_search_tree(rng):
    uv = rng.uniform(0, 300, (250, 2)).astype(np.float32)
    disparity = rng.uniform(5, 60, 250)
    disparity[rng.random(250) < 0.2] = np.nan
    known = np.flatnonzero(np.isfinite(disparity))
    d = disparity[known]
    _, nearest = cKDTree(uv[known]).query(uv[known], k=7)
    like = np.abs(d[nearest[:, 1:]] - d[:, None]) <= np.maximum(2.0, 0.2 * d)[:, None]
    expected = np.zeros(250, bool)
    expected[known] = like.any(axis=1)
    assert 0.3 < expected[known].mean() < 0.9
    np.testing.assert_array_equal(has_consistent_neighbour(uv, disparity, 6), expected)


def test_an_object_with_several_matches_is_consistent(rng):
    uv = rng.uniform([0, 0], [600, 400], (200, 2)).astype(np.float32)
    uv[:4] = [[300, 200], [305, 204], [298, 210], [310, 199]]
    disparity = np.full(200, 8.0)
    disparity[:4] = 30.0
    assert has_consistent_neighbour(uv, disparity, 16).all()
