# SPDX-License-Identifier: Apache-2.0
"""The one group of numbers of an IMU, in the words of its data sheet, for every node that reads one."""

from __future__ import annotations

from dataclasses import dataclass

from slam_core.config import Config, parameter


@dataclass(frozen=True)
class GyroscopeConfig(Config):
    """The noise of a gyroscope; the defaults suit consumer sensors."""

    gyroscope_noise_density: float = parameter(
        1e-3, "white noise of its turn rates", unit="rad/s/sqrt(Hz)", minimum=1e-6
    )
    gyroscope_bias: float = parameter(
        0.02, "standard deviation of the constant error of its turn rates", unit="rad/s", minimum=0.0
    )


@dataclass(frozen=True)
class ImuConfig(GyroscopeConfig):
    """The noise of a gyroscope and an accelerometer."""

    accelerometer_noise_density: float = parameter(
        0.01, "white noise of its specific force", unit="m/s2/sqrt(Hz)", minimum=1e-6
    )
    accelerometer_bias: float = parameter(
        0.15, "standard deviation of the constant error of its specific force", unit="m/s2", minimum=0.0
    )
