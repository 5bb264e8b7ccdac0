# SPDX-License-Identifier: Apache-2.0
"""Each landmark's own share of the noise: nothing where all are alike, the truth where they differ."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.filtering.landmark_noise import LandmarkNoise

LANDMARKS, SIGHTINGS = 200, 40
ALL = np.arange(LANDMARKS)
CLAIMED = np.full((LANDMARKS, 2), 0.04)


def watched(rng: np.random.Generator, sigma: np.ndarray, sightings: int = SIGHTINGS) -> LandmarkNoise:
    """Residuals of standard deviation ``sigma`` (n,) px where 0.2 px are claimed."""
    noise = LandmarkNoise.unknown(LANDMARKS)
    for _ in range(sightings):
        noise.record(ALL, sigma[:, None] * rng.standard_normal((LANDMARKS, 2)), CLAIMED)
    return noise


def test_landmarks_that_are_alike_are_told_apart_by_nothing(rng: np.random.Generator) -> None:
    """Also where the claim is wrong for all of them alike: that is the noise monitor's to say."""
    for sigma in (0.2, 0.1):
        np.testing.assert_array_equal(watched(rng, np.full(LANDMARKS, sigma)).factors(ALL), np.ones(LANDMARKS))


def test_landmarks_that_differ_get_their_own_noise(rng: np.random.Generator) -> None:
    sigma = np.where(ALL % 4 == 0, 0.4, 0.15)
    factors = watched(rng, sigma).factors(ALL)
    truth = sigma**2 / np.mean(sigma**2)
    restless = factors[::4] / truth[::4]
    assert np.mean(restless) == np.clip(np.mean(restless), 0.85, 1.15)
    assert factors[::4].min() > np.delete(factors, ALL[::4]).max()
    assert factors.min() >= 0.5


def test_little_is_said_of_few_sightings(rng: np.random.Generator) -> None:
    sigma = np.where(ALL % 4 == 0, 0.4, 0.15)
    np.testing.assert_array_equal(watched(rng, sigma, sightings=4).factors(ALL), np.ones(LANDMARKS))
    grown = watched(rng, sigma).extended(3)
    np.testing.assert_allclose(grown.factors(LANDMARKS + np.arange(3)), np.ones(3))


def test_one_outlier_is_no_verdict(rng: np.random.Generator) -> None:
    noise = watched(rng, np.where(ALL % 4 == 0, 0.4, 0.15))
    before = noise.factors(ALL)[1]
    noise.record(np.array([1]), np.array([[500.0, 500.0]]), CLAIMED[:1])
    assert noise.factors(ALL)[1] < before + 0.6


def test_removed_slots_are_filled_by_the_last(rng: np.random.Generator) -> None:
    noise = watched(rng, np.linspace(0.1, 0.5, LANDMARKS))
    last = noise.sums[-1]
    noise.remove(7)
    assert len(noise.counts) == len(noise.sums) == LANDMARKS - 1
    assert noise.sums[7] == last
