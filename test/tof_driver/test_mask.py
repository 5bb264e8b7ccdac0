# SPDX-License-Identifier: Apache-2.0
"""Which pixels are believed: each reason on its own, and the kernel against a plain NumPy twin."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tof_driver.mask import (
    MAXIMUM_INCIDENCE_DEG,
    MINIMUM_NEIGHBOURS,
    NOISE_MULTIPLE,
    MaskConfig,
    Reason,
    judge_pixels,
    reject_flying_pixels,
)

CONFIG = MaskConfig()


def full(value: float) -> NDArray[np.float32]:
    return np.full((1, 1), value, dtype=np.float32)


@pytest.mark.parametrize(
    ("distance", "amplitude", "reason"),
    [
        (2.0, 125.0, Reason.VALID),
        (float("nan"), 125.0, Reason.NO_READING),
        (float("inf"), 125.0, Reason.NO_READING),
        (0.0, 125.0, Reason.NO_READING),
        (-1.0, 125.0, Reason.NO_READING),
        (0.1, 2000.0, Reason.OUT_OF_RANGE),
        (7.6, 10.0, Reason.OUT_OF_RANGE),
        (2.0, 1.0, Reason.TOO_DARK),
        (2.0, float("nan"), Reason.TOO_DARK),
        (1.0, 2200.0, Reason.SATURATED),
        (0.0, 2200.0, Reason.SATURATED),
        (0.9, 14.0, Reason.WRAPPED),  # a white wall at 8.4 m returns 14 digits and reads 0.9 m
    ],
)
def test_each_reason(distance: float, amplitude: float, reason: Reason) -> None:
    assert judge_pixels(CONFIG, full(distance), full(amplitude))[0, 0] == reason


def test_without_amplitude_only_the_range_is_judged() -> None:
    distance = np.array([[2.0, 0.05, np.nan]], dtype=np.float32)
    expected = [Reason.VALID, Reason.OUT_OF_RANGE, Reason.NO_READING]
    assert judge_pixels(CONFIG, distance, None).ravel().tolist() == expected


def judging_twin(c: MaskConfig, distance: NDArray[np.float32], amplitude: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The rules of ``judge_pixels``, test by test."""
    reason = np.zeros(distance.shape, dtype=np.uint8)
    with np.errstate(invalid="ignore", over="ignore"):
        reflectivity = amplitude * np.square(distance) / np.float32(c.white_amplitude)
    reason[reflectivity < c.minimum_reflectivity] = Reason.WRAPPED
    reason[(amplitude < c.minimum_amplitude) | ~np.isfinite(amplitude)] = Reason.TOO_DARK
    reason[(distance < c.minimum_range) | (distance > c.maximum_range)] = Reason.OUT_OF_RANGE
    reason[~(np.isfinite(distance) & (distance > 0.0))] = Reason.NO_READING
    reason[amplitude >= c.saturated_amplitude] = Reason.SATURATED
    return reason


def test_judging_against_its_twin(rng: np.random.Generator) -> None:
    distance = rng.uniform(-1.0, 9.0, (40, 50)).astype(np.float32)
    amplitude = rng.choice([3.0, 20.0, 100.0, 1000.0, 2300.0, np.nan, np.inf], distance.shape).astype(np.float32)
    distance[rng.random(distance.shape) < 0.1] = np.nan
    expected = judging_twin(CONFIG, distance, amplitude)
    np.testing.assert_array_equal(judge_pixels(CONFIG, distance, amplitude), expected)
    assert set(expected.ravel()) == set(Reason) - {Reason.FLYING}


def flying_twin(
    distance: NDArray[np.float32], sigma: NDArray[np.float32], read: NDArray[np.bool_], slope: float
) -> NDArray[np.bool_]:
    """The rule of ``reject_flying_pixels``, pixel by pixel."""
    height, width = distance.shape
    flying = np.zeros(distance.shape, dtype=bool)
    for v, u in np.argwhere(read):
        same = 0
        for n, m in ((v + i, u + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)):
            if 0 <= n < height and 0 <= m < width and read[n, m]:
                steps = np.hypot(n - v, m - u)
                limit = steps * slope * min(distance[v, u], distance[n, m])
                limit += NOISE_MULTIPLE * (sigma[v, u] + sigma[n, m]) / np.sqrt(2.0)
                if abs(distance[v, u] - distance[n, m]) > limit:
                    flying[v, u] = True
                same += 1
        flying[v, u] |= same < MINIMUM_NEIGHBOURS
    return flying


def test_kernel_against_its_twin(rng: np.random.Generator) -> None:
    surfaces = rng.choice([1.5, 2.0, 4.0], (30, 40), p=[0.9, 0.05, 0.05])
    distance = (surfaces + 0.02 * rng.normal(size=(30, 40))).astype(np.float32)
    sigma = rng.uniform(0.002, 0.02, distance.shape).astype(np.float32)
    reason = rng.choice([0, 0, 0, 0, 0, 1, 3, 4], distance.shape).astype(np.uint8)
    read = (reason != Reason.NO_READING) & (reason != Reason.SATURATED)
    distance[~read] = rng.choice([0.0, np.nan, 9.0], int((~read).sum()))
    expected = flying_twin(distance, sigma, read, np.tan(np.radians(MAXIMUM_INCIDENCE_DEG)) / 280.0)
    before = reason.copy()
    reject_flying_pixels(distance, sigma, reason, 1.0 / 280.0)
    np.testing.assert_array_equal(reason == Reason.FLYING, expected & (before == Reason.VALID))
    np.testing.assert_array_equal(reason[before != Reason.VALID], before[before != Reason.VALID])
    assert 50 < expected.sum() < 0.9 * expected.size


def test_a_mixed_pixel_goes_and_a_slanted_wall_stays() -> None:
    sigma = np.full((7, 9), 0.003, dtype=np.float32)
    edge = np.where(np.arange(9) < 4, 1.5, 3.0) * np.ones((7, 1))
    edge[:, 4] = 2.2
    reason = np.zeros(edge.shape, dtype=np.uint8)
    reject_flying_pixels(edge.astype(np.float32), sigma, reason, 1.0 / 280.0)
    np.testing.assert_array_equal(reason[3] == Reason.FLYING, [0, 0, 0, 1, 1, 1, 0, 0, 0])
    slanted = 2.0 + 2.0 * np.tan(np.radians(70.0)) / 280.0 * np.arange(9) * np.ones((7, 1))
    reason[:] = 0
    reject_flying_pixels(slanted.astype(np.float32), sigma, reason, 1.0 / 280.0)
    assert not reason.any()


def test_a_dark_neighbour_still_shows_the_edge() -> None:
    distance = np.where(np.arange(9) < 4, 1.5, 3.0) * np.ones((7, 1), dtype=np.float32)
    reason = np.zeros(distance.shape, dtype=np.uint8)
    reason[:, 4:] = Reason.TOO_DARK
    reject_flying_pixels(distance.astype(np.float32), np.full_like(distance, 0.003), reason, 1.0 / 280.0)
    assert (reason[:, 3] == Reason.FLYING).all()
    assert (reason[1:-1, :3] == Reason.VALID).all()
