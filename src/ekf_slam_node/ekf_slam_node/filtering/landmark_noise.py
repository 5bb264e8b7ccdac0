# SPDX-License-Identifier: Apache-2.0
"""Some keypoints are steadier than others: each landmark's own share of the noise, learnt from its residuals.

A detector claims the same standard deviation for all keypoints of one size. Seen again and again, the centre of a
screw head stays within a tenth of it, while that of a shadow, of a reflection or of a pattern at the edge of something
nearer wanders off: the squares of their residuals differ far more than chance allows. How much more tells how much a
landmark's own record is worth beside what holds for all (empirical Bayes with an inverse gamma prior, Gelman et al.
2013, section 3.2). Where all landmarks are alike, as in feature-level simulations, the factors are one.
"""

from __future__ import annotations

import numpy as np

from ekf_slam_node.filtering.covariance import IndexArray
from slam_core.geometry import FloatArray

_MIN_SIGHTINGS = 5
"""Sightings after which a landmark's record tells something of the spread."""
_MIN_LANDMARKS = 20
"""Such landmarks, below which nothing is said."""
_FACTORS = (0.5, 10.0)
"""Limits: a keypoint moves with the view later on, however steady it was so far."""
_OUTLIER = 9.0
"""Larger squares, in claimed variances, count as this one."""


class LandmarkNoise:
    """Squared residuals of landmarks: how many, and their sum in claimed variances, mean of u and v."""

    def __init__(self, counts: FloatArray, sums: FloatArray) -> None:
        self.counts = counts
        self.sums = sums

    @classmethod
    def unknown(cls, landmarks: int) -> LandmarkNoise:
        """Noise of landmarks that were never measured."""
        return cls(np.zeros(landmarks), np.zeros(landmarks))

    def extended(self, landmarks: int) -> LandmarkNoise:
        """With so many new landmarks at the end."""
        new = np.zeros(landmarks)
        return LandmarkNoise(np.concatenate([self.counts, new]), np.concatenate([self.sums, new]))

    def remove(self, slot: int) -> None:
        """Drop a landmark; the last one takes its slot."""
        for values in (self.counts, self.sums):
            values[slot] = values[-1]
        self.counts, self.sums = self.counts[:-1], self.sums[:-1]

    def record(self, slots: IndexArray, residuals: FloatArray, variance: FloatArray) -> None:
        """Take in residuals (k, 2) px of ``slots`` after an update, with the variances (k, 2) that were claimed."""
        self.counts[slots] += 1.0
        self.sums[slots] += np.minimum(np.mean(residuals**2 / variance, axis=1), _OUTLIER)

    def factors(self, slots: IndexArray) -> FloatArray:
        """Factors (k,) on the claimed variances of ``slots``; the mean over all landmarks stays as claimed."""
        known = self.counts >= _MIN_SIGHTINGS
        if known.sum() < _MIN_LANDMARKS:
            return np.ones(len(slots))
        squares = self.sums[known] / self.counts[known]
        level = np.mean(squares)
        # Two coordinates a sighting: chance alone varies their mean square by 1 / counts of its square.
        chance = np.mean(1.0 / self.counts[known])
        allowed = chance * (1.0 + 3.0 * np.sqrt(2.0 / known.sum()))
        spread = (np.var(squares) / level**2 - allowed) / (1.0 + chance)
        if not spread > 0.0:
            return np.ones(len(slots))
        prior = 1.0 + 1.0 / spread
        own = (prior + self.sums[slots] / level) / (prior + self.counts[slots])
        return np.asarray(np.clip(own, *_FACTORS))
