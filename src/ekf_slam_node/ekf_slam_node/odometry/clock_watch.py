# SPDX-License-Identifier: Apache-2.0
"""Watch over a gyroscope's clock: its turns have to come when the images show them.

A filter that thinks its clocks far apart to begin with knows gravity less well for many seconds. So the filter begins
with clocks that agree, and this says when they do not: by a least-squares fit of the gyroscope's bias and of the
clocks' difference to all turns so far.
"""

from __future__ import annotations

import numpy as np

from ekf_slam_node.odometry.preintegration import Preintegral
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray

_SIGMA_S = 0.05
"""Difference of two clocks beforehand."""
_FORGETTING = 0.999
"""Weight of the past at every turn: clocks drift."""
_SIGMAS = 5.0
"""A difference is believed beyond so many standard deviations."""
FARTHEST_S = 0.15
"""Clocks that are further apart are not to be found: readings of so long ago are kept."""
_GATE = chi_square_bound(0.999, 3)
_LEAST_S = 2e-3
"""And from here on: less is in the noise of what a driver calls the time of an image."""


class ClockWatch:
    """Fits (bias rad/s, time offset s) to turns; ``gyroscope_bias``: standard deviation of the bias beforehand."""

    def __init__(self, gyroscope_bias: float) -> None:
        self._prior = np.diag(1.0 / np.square([*3 * [max(gyroscope_bias, 1e-6)], _SIGMA_S]))
        self._information: FloatArray = np.zeros((4, 4))
        self._vector: FloatArray = np.zeros(4)
        self._fit = self._fitted()

    def add(self, pre: Preintegral, turn: FloatArray, covariance: FloatArray) -> None:
        """Take a turn (3,) beyond that of readings without bias and offset, with its covariance (3, 3).

        One half of the readings at the edges gives the regressor, the other half, with noise of its own, the
        instrument, so that noise is not taken for information. A turn that contradicts those before is left out.
        """
        first, second = (np.column_stack([pre.J[:3, :3], clock]) for clock in pre.clock_turns)
        J = 0.5 * (first + second)
        x, P = self._fit
        error = turn - J @ x
        if not float(error @ np.linalg.solve(covariance + J @ P @ J.T, error)) < _GATE:
            return
        inverse = np.linalg.inv(covariance)
        information = first.T @ inverse @ second
        self._information = _FORGETTING * self._information + 0.5 * (information + information.T)
        self._vector = _FORGETTING * self._vector + J.T @ inverse @ turn
        self._fit = self._fitted()

    def contradicted(self, time_offset: float, sigma: float) -> float:
        """Variance (s2) to be added to that of a time offset +- sigma, s, so that it may become the one found; or 0."""
        x, P = self._fit
        if abs(x[3]) > FARTHEST_S:
            return 0.0
        apart = float(x[3]) - time_offset
        bound = max(_SIGMAS * float(np.sqrt(P[3, 3])), _LEAST_S, _SIGMAS * sigma)
        return apart**2 if abs(apart) > bound else 0.0

    def _fitted(self) -> tuple[FloatArray, FloatArray]:
        """The solution (4,) and its covariance (4, 4); the prior where the halves' noise outweighs all."""
        try:
            L = np.linalg.cholesky(self._prior + self._information)
        except np.linalg.LinAlgError:
            return np.zeros_like(self._vector), np.diag(1.0 / np.diagonal(self._prior))
        inverse = np.linalg.inv(L)
        P = inverse.T @ inverse
        return P @ self._vector, P
