"""Standard deviation of keypoint positions, learnt from what a stereo pair shows anyway.

In a rectified pair the two rows of a match are equal, so their difference is a measured residual of the detector: two
localisation errors, no truth needed. It grows with the size of the keypoint. The factor between size and error is kept
as a running robust estimate, and u and v of every keypoint take their standard deviation from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.types import Float32Array

_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class PixelNoiseConfig(Config):
    """``sigma = factor * sqrt(floor^2 + (slope * size)^2)``, the factor measured."""

    floor: float = parameter(0.3, "standard deviation of the smallest keypoints", unit="px", minimum=0.01, maximum=10.0)
    slope: float = parameter(
        0.03, "growth of the standard deviation with the keypoint's diameter", minimum=0.0, maximum=1.0
    )
    memory: float = parameter(
        0.9, "weight of the past in the running factor; 1 keeps it constant", minimum=0.0, maximum=1.0
    )
    min_matches: int = parameter(30, "matches needed in a frame to learn from it", minimum=5)
    min_factor: float = parameter(0.3, "least factor", minimum=0.01)
    max_factor: float = parameter(3.0, "greatest factor", minimum=0.1)


class PixelNoise:
    """Keypoint position noise of one camera pair."""

    def __init__(self, config: PixelNoiseConfig | None = None) -> None:
        self.config = config or PixelNoiseConfig()
        self.factor = 1.0

    def sigma(self, size: Float32Array) -> Float32Array:
        """Standard deviation (px) of u and of v for keypoints of diameter ``size`` (n,) px."""
        return np.asarray(self.factor * self._shape(size), np.float32)

    def learn(self, row_difference: Float32Array, size: Float32Array) -> None:
        """Take in the row differences (n,) px of the matches of one pair, left minus right, of diameter ``size`` (n,)
        px.

        Their median is an error of rectification, not of the detector, and is removed.
        """
        c = self.config
        if len(row_difference) < c.min_matches:
            return
        normalised = (row_difference - np.median(row_difference)) / (np.sqrt(2.0) * self._shape(size))
        measured = float(np.clip(_MAD_TO_SIGMA * np.median(np.abs(normalised)), c.min_factor, c.max_factor))
        self.factor = c.memory * self.factor + (1.0 - c.memory) * measured

    def reset(self) -> None:
        """Forget what was learnt."""
        self.factor = 1.0

    def _shape(self, size: Float32Array) -> Float32Array:
        return np.asarray(np.hypot(self.config.floor, self.config.slope * size), np.float32)
