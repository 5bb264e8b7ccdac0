# SPDX-License-Identifier: Apache-2.0
"""Errors of a time-of-flight camera that are no noise: multipath and wiggling.

Multipath: light that reaches a pixel by way of other surfaces, or scattered inside the lens, adds a phasor that is
smooth over the image and has travelled farther; corners look rounded and dark things too far or too near (Jimenez et
al. 2014). Wiggling: modulation is no pure sine, so range errs periodically, four times per ambiguity range with four
samples per period (Lindner and Kolb 2006; Kahlmann et al. 2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray

_SPREAD = 0.12
"""Standard deviation of the indirect light over the image, as a share of its side."""
_DETOUR = 0.4
"""Length by which indirect light has travelled farther, m."""
_WIGGLES = 4.0


@dataclass(frozen=True)
class TofErrorConfig(Config):
    """Size of the systematic errors."""

    multipath: float = parameter(0.0, "indirect light, as a share of the direct light around", minimum=0.0, maximum=1.0)
    wiggling: float = parameter(0.0, "amplitude of the periodic range error", unit="m", minimum=0.0, maximum=0.5)


def with_indirect_light(phasor: FloatArray, ambiguity_range: float, config: TofErrorConfig) -> FloatArray:
    """Phasor (h, w), complex, with the light that came another way."""
    if config.multipath == 0.0:
        return phasor
    sigma = _SPREAD * len(phasor)
    real, imaginary = (cv2.GaussianBlur(np.ascontiguousarray(p), (0, 0), sigma) for p in (phasor.real, phasor.imag))
    later = np.exp(2j * np.pi * _DETOUR / ambiguity_range)
    return np.asarray(phasor + config.multipath * later * (real + 1j * imaginary))


def wiggle(distance: FloatArray, ambiguity_range: float, config: TofErrorConfig) -> FloatArray:
    """Periodic error of ranges (h, w) m."""
    return np.asarray(config.wiggling * np.sin(_WIGGLES * 2.0 * np.pi * distance / ambiguity_range))
