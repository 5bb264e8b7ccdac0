# SPDX-License-Identifier: Apache-2.0
"""Running estimate of the measurement noise, where it is larger than the features claim.

Keypoints wander when the viewpoint changes, calibrations are never exact, images blur: real errors exceed what a
detector can know about itself. The errors of each frame's associated pairs tell by how much, for pixels and for depth,
and a filter that believes them stays honest. Where the claims are true the factors stay at one.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ekf_slam_node.filtering.models import Frame
from slam_core.geometry import FloatArray

_FORGETTING = 0.9
"""Share of the past in the running estimate of how much larger the noise is than claimed."""
_NOISE_TOLERANCE = 2.0
"""Variances of one frame are enlarged only if its errors exceed them by more than this factor."""
_MAX_NOISE_FACTOR = 25.0
"""Largest factor on the claimed variances; 1 trusts every claim."""

_WATCHED_FRAMES = 20
_FEW_FRAMES = 3
"""Frames with larger errors, among those watched, from which on they are no accident."""

_CHANCE = 0.15
"""Logarithm of a factor that true claims may reach by chance."""


class NoiseMonitor:
    """Running factors (3,) on the variances of u, v and inverse depth, never below one."""

    def __init__(self) -> None:
        self._log_factor = np.zeros(3)

    @property
    def factor(self) -> FloatArray:
        """The present factors on claimed variances (3,); what may be chance is left alone."""
        return np.asarray(np.exp(np.where(self._log_factor > _CHANCE, self._log_factor, 0.0)))

    def corrected(self, frame: Frame) -> Frame:
        """A new frame with the noise that the frames before had."""
        return frame.with_larger_noise(self.factor)

    def learn(self, frame: Frame, ratio: FloatArray) -> Frame:
        """Take in by how much (3,) a corrected frame's errors exceed its variances.

        The frame itself, if far off, corrected.
        """
        limit = np.log(_MAX_NOISE_FACTOR)
        applied = np.log(self.factor)
        own = np.minimum(np.where(ratio > _NOISE_TOLERANCE, ratio, 1.0), np.exp(limit - applied))
        seen = applied + np.log(ratio)
        self._log_factor = np.clip(_FORGETTING * self._log_factor + (1.0 - _FORGETTING) * seen, -_CHANCE, limit)
        return frame.with_larger_noise(own)


class InnovationWatch:
    """Complains where innovations are again and again larger than their covariance says, after all that widens it."""

    def __init__(self) -> None:
        self._ratios = deque[float](maxlen=_WATCHED_FRAMES)

    def add(self, ratio: float) -> None:
        """Take by how much one frame's squared innovations exceed their covariance; 1 where it is true."""
        self._ratios.append(ratio)

    @property
    def diagnostic(self) -> str:
        """Complaint about the frames of late, or ""."""
        high = [ratio for ratio in self._ratios if ratio > _NOISE_TOLERANCE]
        if len(high) < _FEW_FRAMES:
            return ""
        return (
            f"too sure: squared innovations are {np.mean(high):.1f} times their covariance in {len(high)} of the last"
            f" {len(self._ratios)} frames; nearest neighbours pair wrongly, take association.method mahalanobis"
        )
