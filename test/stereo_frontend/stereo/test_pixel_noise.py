# SPDX-License-Identifier: Apache-2.0
"""The noise of keypoint positions is learnt from the rows of matches."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_frontend.stereo.pixel_noise import ROW_FLOOR, ROW_SLOPE, PixelNoise, PixelNoiseConfig


def learn(noise, rng, true_factor, frames=60, offset=0.0):
    size = rng.uniform(12, 60, 200).astype(np.float32)
    for _ in range(frames):
        clean = np.hypot(ROW_FLOOR, ROW_SLOPE * size)
        errors = true_factor * clean * rng.normal(size=(2, 200))
        noise.learn(errors[0] - errors[1] + offset, size)
    return noise


@pytest.mark.parametrize("true_factor", [0.8, 1.0, 1.8])
def test_the_factor_converges_to_the_truth(rng, true_factor):
    assert learn(PixelNoise(), rng, true_factor).factor == pytest.approx(true_factor, rel=0.08)


def test_an_offset_of_the_rows_is_not_noise(rng):
    assert learn(PixelNoise(), rng, 1.0, offset=1.5).factor == pytest.approx(1.0, rel=0.08)


def test_few_matches_teach_nothing(rng):
    noise = PixelNoise()
    noise.learn(np.full(10, 5.0, np.float32), np.full(10, 12.0, np.float32))
    assert noise.factor == 1.0


def test_the_factor_stays_in_its_bounds(rng):
    assert learn(PixelNoise(PixelNoiseConfig(max_factor=1.5)), rng, 4.0).factor == pytest.approx(1.5, rel=0.02)


def test_sigma_scales_with_the_factor_and_grows_with_size():
    noise = PixelNoise()
    before = noise.sigma(np.array([8.0, 40.0], np.float32))
    noise.factor = 2.0
    np.testing.assert_allclose(noise.sigma(np.array([8.0, 40.0], np.float32)), 2 * before)
    assert before[1] > 2 * before[0]


@pytest.mark.parametrize("error", [0.0, 0.1, 0.3])
def test_the_rectification_error_is_what_the_alignment_does_not_explain(rng, error):
    noise = PixelNoise()
    for _ in range(80):
        sigma = rng.uniform(0.03, 0.06, 300)
        noise.learn_rectification(0.5 + sigma * rng.normal(size=300) + error * rng.normal(size=300), sigma)
    assert noise.rectification_sigma == pytest.approx(error, abs=0.015)
