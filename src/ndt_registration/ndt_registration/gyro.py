# SPDX-License-Identifier: Apache-2.0
"""The turn between two scans from an IMU's angular velocities: an optional aid to the prediction of scan odometry."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from slam_core.config import parameter
from slam_core.geometry import FloatArray, so3_exp
from slam_core.imu_config import GyroscopeConfig
from slam_core.types import LONGEST_IMU_STEP_S


@dataclass(frozen=True)
class GyroConfig(GyroscopeConfig):
    """Gyroscope beside scan odometry."""

    enabled: bool = parameter(False, "predict the turn between scans from an IMU: for rigs that turn abruptly")
    time_offset: float = parameter(
        0.0,
        "added to the IMU's stamps, so that they mean the same time as the scans'; calibrate refine writes it",
        unit="s",
        minimum=-1.0,
        maximum=1.0,
    )


class Gyro:
    """The newest angular velocities, along the axes of the scanning sensor."""

    def __init__(self, config: GyroConfig) -> None:
        self._config = config
        self._samples: deque[tuple[int, FloatArray]] = deque()

    def clear(self) -> None:
        """Forget every sample."""
        self._samples.clear()

    def add(self, stamp_ns: int, rate: FloatArray) -> None:
        """Angular velocity (3,) rad/s at a stamp; one that is not newer than the last is left out."""
        if self._config.enabled and (not self._samples or stamp_ns > self._samples[-1][0]):
            self._samples.append((stamp_ns, rate))

    def turn(self, start_ns: int, end_ns: int) -> FloatArray | None:
        """Rotation R_start_end (3, 3), each rate held until the next; None where samples are missing.

        Samples before ``end_ns`` are dropped but for the last.
        """
        while len(self._samples) > 1 and self._samples[1][0] <= start_ns:
            self._samples.popleft()
        R: FloatArray | None = np.eye(3) if self._samples else None
        now = start_ns
        while R is not None and now < end_ns:
            stamp, rate = self._samples[0]
            until = min(self._samples[1][0] if len(self._samples) > 1 else end_ns, end_ns)
            if 1e-9 * (until - stamp) > LONGEST_IMU_STEP_S or stamp > now:
                return None
            R = R @ so3_exp(rate * 1e-9 * (until - now))
            now = until
            if now < end_ns:
                self._samples.popleft()
        return R

    def sigma(self, seconds: float) -> float:
        """Standard deviation of a turn over ``seconds``, rad about each axis."""
        config = self._config
        return float(config.gyroscope_bias * seconds + config.gyroscope_noise_density * seconds**0.5)
