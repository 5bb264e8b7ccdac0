# SPDX-License-Identifier: Apache-2.0
"""Smoke: contrast falls with distance, and the light of a ToF camera is lost on both ways and scattered back.

Homogeneous smoke attenuates light by ``exp(-density z)`` and adds as much of the air's own light (Koschmieder 1924).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import Float32Array

_BACKSCATTER = 0.1
"""Light that comes back from the smoke, over that of a white surface at 1 m, per unit of density."""
_BACKSCATTER_RANGE = 0.5
"""Length of the way that most of it comes from, m."""


@dataclass(frozen=True)
class SmokeConfig(Config):
    """Density of the smoke."""

    density: float = parameter(
        0.0, "extinction: 0.02 is haze, 0.3 a burning room", unit="1/m", minimum=0.0, maximum=5.0
    )


def seen_through(image: Float32Array, depth: Float32Array, config: SmokeConfig) -> Float32Array:
    """Radiance (h, w) of surfaces at ``depth`` (h, w) m as it arrives; the air has the mean light of the image."""
    if config.density == 0.0:
        return image
    left = np.exp(-np.float32(config.density) * np.where(depth > 0.0, depth, np.float32(1e3)))
    return np.asarray(image * left + image.mean() * (1.0 - left), dtype=np.float32)


def echo_through(
    phasor: FloatArray, distance: FloatArray, ambiguity_range: float, full: float, config: SmokeConfig
) -> FloatArray:
    """Phasor (h, w) of surfaces at ``distance`` (h, w) m along the ray; ``full`` is a white surface's at 1 m."""
    if config.density == 0.0:
        return phasor
    wave = 2.0 * np.pi / ambiguity_range
    back = _BACKSCATTER * config.density * full * np.exp(1j * wave * _BACKSCATTER_RANGE)
    return np.asarray(phasor * np.exp(-2.0 * config.density * distance) + back)
