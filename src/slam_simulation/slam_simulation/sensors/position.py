# SPDX-License-Identifier: Apache-2.0
"""Positions of an antenna on the rig in the frame of the building, as UWB has them: noisy, and some far off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, make_transform, rotation_from_euler, transform_points
from slam_core.types import PositionReading
from slam_simulation.trajectory import Path

BUILDING_FRAME = "building"
T_BUILDING_WORLD = make_transform(rotation_from_euler(np.radians(35.0)), np.array([40.0, -25.0, 6.0]))
"""Pose of the simulated world in the frame of the positions."""


@dataclass(frozen=True)
class PositionSensorConfig(Config):
    """An antenna that is located in the building."""

    rate: float = parameter(5.0, "positions per second", unit="Hz", minimum=0.1)
    sigma: float = parameter(0.1, "noise along each axis, which is reported", unit="m", minimum=1e-3)
    outlier_share: float = parameter(0.1, "share of positions that are far off", minimum=0.0, maximum=1.0)
    outlier_distance: float = parameter(5.0, "how far off these are, which is not reported", unit="m", minimum=0.0)
    lever_arm: tuple[float, ...] = parameter((0.0, 0.1, 0.25), "place of the antenna on the rig", unit="m")


class PositionSensor:
    """Locates one path's antenna; the readings do not depend on how often they are asked for."""

    def __init__(self, config: PositionSensorConfig, path: Path, seed: tuple[int, ...]) -> None:
        self.config = config
        self._stamps = np.arange(int(np.floor(path.duration * config.rate + 1e-9)) + 1) / config.rate
        arm, rng, n = np.array([config.lever_arm]), np.random.default_rng(seed), len(self._stamps)
        places = np.concatenate([transform_points(T_BUILDING_WORLD @ path.pose(t), arm) for t in self._stamps])
        off = rng.standard_normal((n, 3))
        off *= config.outlier_distance / np.linalg.norm(off, axis=1, keepdims=True)
        self.is_outlier = rng.random(n) < config.outlier_share
        self._places: FloatArray = places + config.sigma * rng.standard_normal((n, 3)) + self.is_outlier[:, None] * off

    def read(self, first_s: float, last_s: float, start_ns: int) -> tuple[PositionReading, ...]:
        """Readings after ``first`` up to ``last``; ``start_ns``: stamp of time zero."""
        inside = np.flatnonzero((self._stamps > first_s + 1e-9) & (self._stamps <= last_s + 1e-9))
        covariance = self.config.sigma**2 * np.eye(3)
        stamps = [start_ns + round(float(self._stamps[k]) * 1e9) for k in inside]
        return tuple(PositionReading(s, self._places[k], covariance) for s, k in zip(stamps, inside, strict=True))
