# SPDX-License-Identifier: Apache-2.0
"""Position noise of keypoints and disparities, from their size and from what a stereo pair shows anyway.

Seen again from elsewhere, a keypoint lies off the surface point it was first found on by an error that grows with its
size (measured on simulated rooms, frames 0.3 s apart). How good the images are shows in every rectified pair: the two
rows of a match are equal, so their difference is a measured residual of the detector, no truth needed. Its ratio to
that of a clean image scales the standard deviations of u and v, as a running robust estimate. Rows that differ by more
than the alignment of the patches leaves open are an error of lens model and rectification; it bends disparities as it
bends rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.estimation.least_squares import MAD_TO_SIGMA
from slam_core.types import Float32Array

ROW_FLOOR = 0.06
"""Standard deviation of the row of the smallest keypoints in one clean image, px."""
ROW_SLOPE = 0.003
"""Growth of that with the keypoint's diameter."""
_FORGETTING = 0.9
"""Weight of the past in the running factor; 1 keeps it constant."""
_MIN_MATCHES = 30
"""Matches needed in a frame to learn from it."""
_MIN_FACTOR = 0.7
"""Least factor."""
_SLOPE = 0.015
"""Growth of the standard deviation with the keypoint's diameter."""


@dataclass(frozen=True)
class PixelNoiseConfig(Config):
    """Position: ``factor * sqrt(floor^2 + (slope * size)^2)``.

    Rows of a clean pair: the same form without the factor.
    """

    floor: float = parameter(
        0.11, "standard deviation of the smallest keypoints", unit="px", minimum=0.01, maximum=10.0
    )
    max_factor: float = 3.0
    """Greatest factor."""


class PixelNoise:
    """Keypoint position noise of one camera pair; ``factor`` compares its images with clean ones."""

    def __init__(self, config: PixelNoiseConfig | None = None) -> None:
        self.config = config or PixelNoiseConfig()
        self.factor = 1.0
        self.rectification_sigma = 0.0
        """Standard deviation (px) of the rectification's error over the image, beyond its mean."""

    def sigma(self, size: Float32Array) -> Float32Array:
        """Standard deviation (px) of u and of v for keypoints of diameter ``size`` (n,) px."""
        return np.asarray(self.factor * np.hypot(self.config.floor, _SLOPE * size), np.float32)

    def learn(self, row_difference: Float32Array, size: Float32Array) -> None:
        """Take in the row differences (n,) px of the matches of one pair, left minus right.

        ``size``: (n,) px, diameters of the keypoints.

        Their median is an error of rectification, not of the detector, and is removed.
        """
        c = self.config
        if len(row_difference) < _MIN_MATCHES:
            return
        clean = np.sqrt(2.0) * np.hypot(ROW_FLOOR, ROW_SLOPE * size)
        normalised = (row_difference - np.median(row_difference)) / clean
        measured = float(np.clip(MAD_TO_SIGMA * np.median(np.abs(normalised)), _MIN_FACTOR, c.max_factor))
        self.factor = _FORGETTING * self.factor + (1.0 - _FORGETTING) * measured

    def learn_rectification(self, row_shift: Float32Array, row_sigma: Float32Array) -> None:
        """Take in the row shifts (n,) px of aligned patches and their standard deviations (n,) px."""
        if len(row_shift) < _MIN_MATCHES:
            return
        spread = MAD_TO_SIGMA * np.median(np.abs(row_shift - np.median(row_shift)))
        excess = np.sqrt(max(0.0, float(spread**2 - np.median(row_sigma) ** 2)))
        forgetting = _FORGETTING
        self.rectification_sigma = forgetting * self.rectification_sigma + (1.0 - forgetting) * excess

    def reset(self) -> None:
        """Forget what was learnt."""
        self.factor, self.rectification_sigma = 1.0, 0.0
