"""The noise of keypoint positions is learnt from the rows of matches."""

from __future__ import annotations

import numpy as np
import pytest

from stereo_frontend.pixel_noise import PixelNoise, PixelNoiseConfig


def learn(noise, rng, true_factor, frames=60, offset=0.0):
    size = rng.uniform(12, 60, 200).astype(np.float32)
    for _ in range(frames):
        shape = noise.sigma(size) / noise.factor
        errors = true_factor * shape * rng.normal(size=(2, 200))
        noise.learn(errors[0] - errors[1] + offset, size)
    return noise


@pytest.mark.parametrize("true_factor", [0.5, 1.0, 1.8])
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
