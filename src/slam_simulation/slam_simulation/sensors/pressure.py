# SPDX-License-Identifier: Apache-2.0
"""A barometer: pressure of the air at the rig's height, with noise, and drift by weather, doors and ventilation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.types import PressureReading
from slam_simulation.trajectory import Path

_GROUND_PA = 100_900.0
_METRES_PER_KELVIN = 29.27
"""R / (g M) of dry air, m/K."""


@dataclass(frozen=True)
class PressureSensorConfig(Config):
    """A MEMS barometer as in telephones."""

    rate: float = parameter(10.0, "readings per second", unit="Hz", minimum=0.1)
    sigma: float = parameter(1.5, "noise of a reading, which is reported", unit="Pa", minimum=1e-3)
    drift: float = parameter(0.02, "random walk, as a height", unit="m/sqrt(s)", minimum=0.0)
    temperature: float = parameter(294.0, "temperature of the air", unit="K", minimum=200.0, maximum=340.0)


class PressureSensor:
    """Reads one path's heights; the readings do not depend on how often they are asked for."""

    def __init__(self, config: PressureSensorConfig, path: Path, seed: tuple[int, ...]) -> None:
        self.config = config
        self._stamps = np.arange(int(np.floor(path.duration * config.rate + 1e-9)) + 1) / config.rate
        rng, n = np.random.default_rng(seed), len(self._stamps)
        walk = np.cumsum(rng.standard_normal(n)) * config.drift / np.sqrt(config.rate)
        heights = np.array([path.pose(t)[2, 3] for t in self._stamps]) + walk
        ideal = _GROUND_PA * np.exp(-heights / (_METRES_PER_KELVIN * config.temperature))
        self._pressures = ideal + config.sigma * rng.standard_normal(n)

    def read(self, first_s: float, last_s: float, start_ns: int) -> tuple[PressureReading, ...]:
        """Readings after ``first`` up to ``last``; ``start_ns``: stamp of time zero."""
        inside = np.flatnonzero((self._stamps > first_s + 1e-9) & (self._stamps <= last_s + 1e-9))
        stamps = [start_ns + round(float(self._stamps[k]) * 1e9) for k in inside]
        variance = self.config.sigma**2
        return tuple(
            PressureReading(stamp, float(self._pressures[k]), variance) for stamp, k in zip(stamps, inside, strict=True)
        )
