# SPDX-License-Identifier: Apache-2.0
"""The inertial sensor: angular velocity and specific force of the rig with bias and white noise.

Differentiated numerically from the trajectory, which has continuous second derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, so3_log
from slam_core.types import GRAVITY, ImuSample
from slam_simulation.trajectory import Path

STEP = 1e-3


@dataclass(frozen=True)
class ImuSensorConfig(Config):
    """A MEMS sensor of the consumer class."""

    rate: float = parameter(100.0, "readings per second", unit="Hz", minimum=1.0)
    gyro_noise: float = parameter(0.003, "noise of one angular velocity reading", unit="rad/s", minimum=0.0)
    gyro_bias: float = parameter(0.004, "spread of the constant angular velocity error", unit="rad/s", minimum=0.0)
    accel_noise: float = parameter(0.03, "noise of one acceleration reading", unit="m/s2", minimum=0.0)
    accel_bias: float = parameter(0.05, "spread of the constant acceleration error", unit="m/s2", minimum=0.0)


class ImuSensor:
    """Reads the motion of one path."""

    def __init__(self, config: ImuSensorConfig, seed: tuple[int, ...]) -> None:
        self.config = config
        self._seed = seed
        rng = np.random.default_rng([*seed, 1])
        self.gyro_bias = config.gyro_bias * rng.standard_normal(3)
        self.accel_bias = config.accel_bias * rng.standard_normal(3)

    def read(self, path: Path, first_s: float, last_s: float, start_ns: int) -> tuple[ImuSample, ...]:
        """Samples at multiples of the period after ``first`` up to ``last``; ``start_ns``: stamp of time zero."""
        c = self.config
        k0, k1 = int(np.floor(first_s * c.rate + 1e-9)) + 1, int(np.floor(last_s * c.rate + 1e-9))
        samples = []
        for k in range(k0, k1 + 1):
            t = k / c.rate
            rng = np.random.default_rng([*self._seed, 2, k])
            rotation_rate, force = ideal_reading(path, t)
            rotation_rate = rotation_rate + self.gyro_bias + c.gyro_noise * rng.standard_normal(3)
            force = force + self.accel_bias + c.accel_noise * rng.standard_normal(3)
            samples.append(ImuSample(start_ns + round(t * 1e9), rotation_rate, force))
        return tuple(samples)


def ideal_reading(path: Path, t: float) -> tuple[FloatArray, FloatArray]:
    """Angular velocity (3,) rad/s and specific force (3,) m/s2 in the rig frame."""
    before, now, after = path.pose(t - STEP), path.pose(t), path.pose(t + STEP)
    R = now[:3, :3]
    acceleration = (after[:3, 3] - 2.0 * now[:3, 3] + before[:3, 3]) / STEP**2
    rotation_rate = so3_log(before[:3, :3].T @ after[:3, :3]) / (2.0 * STEP)
    return rotation_rate, np.asarray(R.T @ (acceleration + np.array([0.0, 0.0, GRAVITY])))
