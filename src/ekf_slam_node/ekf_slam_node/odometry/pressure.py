# SPDX-License-Identifier: Apache-2.0
"""Heights by air pressure (hypsometric equation): differences over a minute, whose scale is that of the temperature.

h2 - h1 = -R T / (g M) ln(p2 / p1),    29.27 m/K T, 8434 m at 15 degrees C
"""

from __future__ import annotations

from collections import deque
from math import isfinite

import numpy as np

from ekf_slam_node.config import RideConfig
from slam_core.geometry import FloatArray
from slam_core.types import PressureReading

SCALE_HEIGHT = 8434.0
"""Metres by which pressure falls to 1 / e in air of 15 degrees C."""
USUAL_PA = 3e4, 1.2e5
"""Pressures (Pa) of air that people breathe."""
_KEPT_NS = 400_000_000_000
_MEAN_NS = 1_000_000_000
"""The height before a ride is a mean over so long."""
_NEAR_NS = 150_000_000
"""A frame's height is that of the reading at most so far from it."""
_INDEPENDENT = 4
"""Readings of that mean whose errors are taken to be independent."""


class PressureHeights:
    """The newest readings of one barometer as heights above the first of them."""

    def __init__(self, config: RideConfig) -> None:
        self._config = config
        self._readings: deque[tuple[int, float, float]] = deque()
        self._first = 0.0
        self._reference = np.nan
        self._used_ns = 0

    def add(self, reading: PressureReading) -> str:
        """Take a reading; returns why it is rejected, or ""."""
        if not isfinite(reading.pressure) or not USUAL_PA[0] < reading.pressure < USUAL_PA[1]:
            return "of no air"
        if self._readings and reading.stamp_ns <= self._readings[-1][0]:
            return "not newer"
        self._first = self._first or reading.pressure
        height = -SCALE_HEIGHT * float(np.log(reading.pressure / self._first))
        told = reading.variance if isfinite(reading.variance) and reading.variance > 0.0 else 0.0
        sigma = SCALE_HEIGHT * np.sqrt(told) / reading.pressure if told else self._config.sigma_pressure_height
        self._readings.append((reading.stamp_ns, height, float(sigma) ** 2))
        while self._readings[0][0] < reading.stamp_ns - _KEPT_NS:
            self._readings.popleft()
        return ""

    @property
    def is_heard(self) -> bool:
        """True from the first usable reading on."""
        return bool(self._readings)

    def start(self, stamp_ns: int) -> float:
        """Take the height before a stamp as that of a ride's start; returns its standard deviation, m."""
        before = [r for r in self._readings if stamp_ns - _MEAN_NS <= r[0] <= stamp_ns]
        if not before:
            self._reference = np.nan
            return self._config.sigma_pressure_height
        self._reference = float(np.mean([height for _, height, _ in before]))
        variance = float(np.mean([v for *_, v in before])) / min(len(before), _INDEPENDENT)
        return float(np.sqrt(variance))

    def since(self, start_ns: int, stamp_ns: int) -> tuple[float, float] | None:
        """Height (m) of a stamp above a ride's start, with the variance of one reading; None without a new reading."""
        if np.isnan(self._reference) or stamp_ns <= start_ns or not self._readings:
            return None
        at, height, variance = min(self._readings, key=lambda reading: abs(reading[0] - stamp_ns))
        if abs(at - stamp_ns) > _NEAR_NS or at <= self._used_ns:
            return None
        self._used_ns = at
        return height - self._reference, variance

    def recent(self, start_ns: int, stamp_ns: int) -> FloatArray:
        """Readings (n, 3) since a ride's start in the second before a stamp.

        Columns: stamp, ns, height above the start, m, and the variance of the mean of all these heights, m2.
        """
        first_ns = max(start_ns, stamp_ns - _MEAN_NS)
        kept = np.array([r for r in self._readings if first_ns < r[0] <= stamp_ns]).reshape(-1, 3)
        if np.isnan(self._reference) or not len(kept):
            return np.zeros((0, 3))
        kept[:, 1] -= self._reference
        kept[:, 2] = kept[:, 2].mean() / min(len(kept), _INDEPENDENT)
        return kept
