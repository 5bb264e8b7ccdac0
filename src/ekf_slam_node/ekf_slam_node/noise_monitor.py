"""How much larger the measurement noise is than the features claim.

Keypoints wander when the viewpoint changes, calibrations are never exact, images blur: real errors exceed what a
detector can know about itself. The errors of each frame's associated pairs tell by how much, for pixels and for depth,
and a filter that believes them stays honest. Where the claims are true the factors stay at one.
"""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import MeasurementConfig
from ekf_slam_node.models import Frame
from slam_core.geometry import FloatArray


class NoiseMonitor:
    """Running factors (3,) on the variances of u, v and inverse depth, never below one."""

    def __init__(self, config: MeasurementConfig) -> None:
        self._config = config
        self._log_factor = np.zeros(3)

    @property
    def factor(self) -> FloatArray:
        """The present factors on claimed variances (3,)."""
        return np.asarray(np.exp(self._log_factor))

    def corrected(self, frame: Frame) -> Frame:
        """A new frame with the noise that the frames before had."""
        return frame.with_larger_noise(self.factor)

    def learn(self, frame: Frame, ratio: FloatArray) -> Frame:
        """Take in by how much (3,) a corrected frame's errors exceed its variances; the frame itself, if far off,
        corrected.
        """
        limit = np.log(self._config.max_noise_factor)
        weight = 1.0 - self._config.noise_memory
        own = np.minimum(np.where(ratio > self._config.noise_tolerance, ratio, 1.0), np.exp(limit - self._log_factor))
        self._log_factor = np.clip(self._log_factor + weight * np.log(ratio), 0.0, limit)
        return frame.with_larger_noise(own)
