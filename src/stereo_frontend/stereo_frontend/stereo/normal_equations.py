# SPDX-License-Identifier: Apache-2.0
"""Evidence on a few numbers as normal equations, and their estimate where pieces of it are not independent.

Errors within a frame, and of a landmark over frames, are not independent. So the covariance is not that of the normal
equations alone, but the sandwich estimate over groups of pieces (White 1980; Liang and Zeger 1986), drawn towards the
former while there are few groups.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray

MEDIAN_CHI_SQUARE_1 = 0.455
"""Median of chi-square of one degree of freedom."""
_ROBUST_SCALE = 9.0
"""Squared residual, in its variance, at which a measurement has half its weight (Cauchy)."""
_PRIOR_GROUPS = 5.0
"""Weight of the normal equations' own covariance, in groups."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """``information @ parameters = vector`` of one piece of evidence, (k, k) and (k,)."""

    information: FloatArray
    vector: FloatArray

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(self.information + other.information, self.vector + other.vector)


class EvidenceWindow:
    """The newest pieces of evidence, as sums of ``group`` consecutive ones, which are not independent.

    At most ``pieces`` are remembered; the oldest group goes as a whole.
    """

    def __init__(self, group: int, pieces: int) -> None:
        self._group = group
        self._last = group
        self.sums: deque[NormalEquations] = deque(maxlen=pieces // group)

    def __len__(self) -> int:
        """Number of pieces."""
        return (len(self.sums) - 1) * self._group + self._last if self.sums else 0

    def add(self, piece: NormalEquations) -> None:
        """Take one piece."""
        if self._last == self._group:
            self.sums.append(piece)
            self._last = 1
        else:
            self.sums[-1] = self.sums[-1] + piece
            self._last += 1

    def clear(self) -> None:
        """Forget everything."""
        self.sums.clear()
        self._last = self._group


def robust_weights(squares: FloatArray, noise: float, variance: FloatArray | float = 1.0) -> FloatArray:
    """Weights (n,) of measurements by their squared residuals (n,) in ``variance``, which is too small by ``noise``."""
    return np.asarray(1.0 / (noise * variance) / (1.0 + squares / noise / _ROBUST_SCALE))


def sandwich_estimate(groups: Collection[NormalEquations], prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solution (k,) of all groups of evidence and a prior information (k, k) about zero, with its covariance (k, k).

    What is in one group is not independent, the groups are.
    """
    information = np.array([e.information for e in groups])
    vectors = np.array([e.vector for e in groups])
    total = prior + information.sum(axis=0)
    theta = np.linalg.solve(total, vectors.sum(axis=0))
    scores = vectors - information @ theta
    lower = np.linalg.cholesky(total)
    whitened = np.linalg.solve(lower, scores.T)
    ratio, axes = np.linalg.eigh(whitened @ whitened.T)
    share = len(scores) / (len(scores) + _PRIOR_GROUPS)
    # What scatters more than the equations claim is believed; what by chance scatters less is not.
    half = np.linalg.solve(lower.T, axes) * np.sqrt(1.0 + share * np.maximum(ratio - 1.0, 0.0))
    return theta, half @ half.T
