# SPDX-License-Identifier: Apache-2.0
"""The 8-bit pictures of a ToF camera in which features are searched."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.types import DepthImage
from stereo_frontend.depth.depth_lookup import sample_depth
from stereo_frontend.depth.tof_features import TofFeatureConfig, TofFeatures, normalised_picture
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.stereo.pixel_noise import PixelNoiseConfig
from stereo_frontend.tracking.mapping_pace import MappingPace


def twin(values, clip, gamma):
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite[:: max(1, finite.size // 20000)], [clip, 1.0 - clip])
    unit = np.clip((values - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return np.asarray(255.0 * np.nan_to_num(unit, nan=1.0) ** np.float32(gamma) + 0.5).astype(np.uint8)


@pytest.mark.parametrize("gamma", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_pictures_are_those_of_the_twin(rng, gamma, missing):
    values = rng.gamma(2.0, 100.0, (180, 240)).astype(np.float32)
    values[rng.random(values.shape) < missing] = np.nan
    picture = normalised_picture(values, 0.005, gamma)
    np.testing.assert_array_equal(picture, twin(values, 0.005, gamma))
    assert (picture[~np.isfinite(values)] == 255).all()


def test_images_without_contrast_or_values_are_black():
    assert not normalised_picture(np.full((4, 5), np.nan, np.float32), 0.005, 0.5).any()
    assert not normalised_picture(np.ones((4, 5), np.float32), 0.005, 0.5).any()


def test_features_are_those_of_all_keypoints_less_those_without_depth(stereo_pair):
    pair = stereo_pair()
    depth = np.full(pair.left.shape, 2.0, np.float32)
    depth[:, :150] = np.nan
    sigma = np.full(pair.left.shape, 0.01, np.float32)
    image = DepthImage(1, depth, sigma, pair.stereo.camera, amplitude=pair.left.astype(np.float32))
    tof = TofFeatures(TofFeatureConfig(), FeatureConfig(target=200), PixelNoiseConfig(), None, MappingPace(0.0))
    features = tof(image)
    every = FeatureExtractor(FeatureConfig(target=200))(tof.picture(image, "amplitude"))
    known = np.isfinite(sample_depth(image, every.uv).depth)
    assert 50 < known.sum() < 150
    np.testing.assert_array_equal(features.uv, every.uv[known])
    np.testing.assert_array_equal(features.descriptors, every.descriptors[known])
    np.testing.assert_allclose(features.depth, 2.0)
