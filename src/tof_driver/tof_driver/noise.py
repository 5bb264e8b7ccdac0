# SPDX-License-Identifier: Apache-2.0
"""Standard deviation of a range measurement from what the sensor tells with it.

Time of flight (continuous-wave modulation): the phase noise is inversely proportional to the amplitude of the returned
light (Lange and Seitz 2001), which itself falls with the square of the range. Structured light and active stereo:
the disparity noise is constant, so the depth noise grows with the square of depth (Khoshelham and Elberink 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.types import Float32Array


@dataclass(frozen=True)
class NoiseConfig(Config):
    """Noise model of a depth camera; the defaults are the CamCube's (thesis 2.2: below 3 mm at 2 m)."""

    model: str = parameter(
        "auto",
        "amplitude: time of flight, sigma from amplitude (from range squared where there is no amplitude image); "
        "quadratic: structured light or stereo, sigma = constant + quadratic * depth^2; "
        "auto: amplitude for cameras that measure range, quadratic for those that measure depth",
        choices=("auto", "amplitude", "quadratic"),
    )
    reference_range: float = parameter(
        2.0, "range at which reference_sigma and reference_amplitude hold", unit="m", minimum=0.1
    )
    reference_sigma: float = parameter(0.003, "standard deviation at the reference", unit="m", minimum=1e-5)
    reference_amplitude: float = parameter(
        125.0, "amplitude at which reference_sigma holds: grey wall at the reference range", unit="digits", minimum=1e-6
    )
    floor: float = parameter(
        0.002, "part of sigma that no light removes: constant range errors of the pixels", unit="m", minimum=0.0
    )
    constant: float = parameter(0.0012, "model quadratic: sigma at depth zero", unit="m", minimum=0.0)
    quadratic: float = parameter(
        0.001425,
        "model quadratic: growth with depth squared (Kinect: Khoshelham and Elberink 2012)",
        unit="1/m",
        minimum=0.0,
    )


def range_sigma(config: NoiseConfig, distance: Float32Array, amplitude: Float32Array | None) -> Float32Array:
    """Standard deviation (m) of each range; any shape.

    Parameters
    ----------
    config
        Noise model.
    distance
        Range along the ray (model amplitude) or depth along z (model quadratic), m; NaN passes through.
    amplitude
        Same shape, sensor digits; None where the sensor has none.
    """
    if config.model == "quadratic":
        return np.asarray(config.constant + config.quadratic * distance * distance, dtype=np.float32)
    if amplitude is None:
        relative = np.square(distance / np.float32(config.reference_range))
    else:
        relative = np.float32(config.reference_amplitude) / np.maximum(amplitude, np.float32(1e-6))
    # The same as hypot, which guards against overflow at twice the time.
    squared = np.square(config.reference_sigma * relative, dtype=np.float64)
    return np.asarray(np.sqrt(np.float64(np.float32(config.floor)) ** 2 + squared), dtype=np.float32)
