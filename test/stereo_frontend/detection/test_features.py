# SPDX-License-Identifier: Apache-2.0
"""The feature interface: coverage, threshold tracking, unit norm, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereo_frontend.detection.features import DETECTORS, FeatureConfig, FeatureExtractor
from stereo_frontend.detection.opencv_detectors import from_bits
from stereo_frontend.keypoints import spread_over_grid


@pytest.mark.parametrize("name", DETECTORS)
def test_every_detector_gives_unit_descriptors_in_a_fixed_order(name, stereo_pair):
    image = stereo_pair().left
    first, second = (FeatureExtractor(FeatureConfig(detector=name, target=200))(image) for _ in range(2))
    assert 100 <= len(first) <= 200
    for field in ("uv", "size", "response", "descriptors"):
        assert getattr(first, field).dtype == np.float32
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))
    np.testing.assert_allclose(np.linalg.norm(first.descriptors, axis=1), 1.0, atol=1e-5)
    assert np.all((first.uv >= 0) & (first.uv <= [320, 240]))


def test_the_scalar_product_of_binary_strings_counts_their_differing_bits(rng):
    packed = rng.integers(0, 256, (2, 32), dtype=np.uint8)
    hamming = cv2.norm(packed[:1], packed[1:], cv2.NORM_HAMMING)
    vectors = from_bits(packed)
    assert vectors[0] @ vectors[1] == pytest.approx(1 - 2 * hamming / 256, abs=1e-6)


def test_the_grid_takes_the_best_of_each_cell_first(rng):
    uv = rng.uniform([0, 0], [100, 80], (500, 2)).astype(np.float32)
    crowded = np.vstack([uv[:20], rng.uniform([0, 0], [10, 8], (480, 2))]).astype(np.float32)
    response = rng.uniform(1, 2, 500).astype(np.float32)
    response[20:] += 5.0
    kept = spread_over_grid(crowded, response, (80, 100), (8, 10), 60)
    assert len(kept) == 60
    lonely = {i for i in range(20) if not np.all(crowded[i] < [10, 8])}
    alone = {i for i in lonely if sum(np.array_equal(crowded[i] // 10, crowded[j] // 10) for j in lonely) == 1}
    assert alone <= set(kept.tolist())


@pytest.mark.parametrize("digits", [7, 1])
def test_the_grid_takes_strength_in_turn_equals_by_place(rng, digits):
    uv = rng.uniform([0, 0], [100, 80], (400, 2)).astype(np.float32)
    response = np.round(rng.uniform(1, 2, 400), digits).astype(np.float32)
    cell = (uv[:, 1] // 10).astype(int) * 10 + (uv[:, 0] // 10).astype(int)
    order = np.lexsort((uv[:, 0], uv[:, 1], -response, cell))
    rank = np.array([np.sum(cell[order[:k]] == cell[order[k]]) for k in range(400)])
    expected = order[np.lexsort((-response[order], rank))][:150]
    np.testing.assert_array_equal(spread_over_grid(uv, response, (80, 100), (8, 10), 150), expected)


def test_the_threshold_settles_so_that_one_pass_suffices(stereo_pair):
    extractor = FeatureExtractor(FeatureConfig(target=150))
    thresholds = []
    for _ in range(6):
        keypoints = extractor(stereo_pair().left)
        thresholds.append(extractor.threshold)
    assert len(keypoints) == 150
    assert abs(np.log(thresholds[-1] / thresholds[-2])) < 0.02


@pytest.mark.parametrize("name", DETECTORS)
def test_only_wanted_keypoints_are_described_and_the_others_change_nothing(stereo_pair, name):
    image = stereo_pair().left
    extractors = [FeatureExtractor(FeatureConfig(detector=name, target=150)) for _ in range(2)]
    every, wanted = extractors[0](image), extractors[1](image, None, lambda uv: uv[:, 0] < 100.0)
    left = every.select(every.uv[:, 0] < 100.0)
    assert 20 < len(left) < 100
    for field in ("uv", "size", "response", "descriptors"):
        np.testing.assert_array_equal(getattr(wanted, field), getattr(left, field))
    assert extractors[0].threshold == extractors[1].threshold


def test_a_dim_image_still_gives_its_features(stereo_pair):
    dim = (stereo_pair(noise=0.0).left // 6).astype(np.uint8)
    assert len(FeatureExtractor(FeatureConfig(target=150))(dim)) > 100


@pytest.mark.parametrize("grey", [0, 255])
def test_images_without_texture_have_no_features(grey):
    assert len(FeatureExtractor()(np.full((120, 160), grey, np.uint8))) == 0


def test_colour_and_16_bit_images_are_refused():
    for image in (np.zeros((10, 10, 3), np.uint8), np.zeros((10, 10), np.uint16)):
        with pytest.raises(ValueError, match="uint8 grey"):
            FeatureExtractor()(image)
