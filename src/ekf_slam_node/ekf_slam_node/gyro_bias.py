# SPDX-License-Identifier: Apache-2.0
"""The constant error of a gyroscope, learnt from the turns that the images show.

Taken for fresh noise, a bias of 0.2 degrees per second pulls every frame the same way, and its small weight beside the
images adds up to a drift of height and heading. Their own turns have no such bias, so the difference of the two shows
it: a Kalman filter of three states, which a walk keeps from growing too sure.
"""

from __future__ import annotations

import numpy as np

from ekf_slam_node.config import MotionConfig
from slam_core.geometry import FloatArray
from slam_core.least_squares import chi_square_bound

_GATE = chi_square_bound(0.999, 3)
"""A turn that differs more is not the bias's doing."""


class GyroBias:
    """``rate`` (3,) rad/s along the rig's axes, what is to be subtracted from readings; covariance (3, 3)."""

    def __init__(self, config: MotionConfig) -> None:
        self.rate = np.zeros(3)
        self.covariance = np.eye(3) * config.sigma_gyro_bias**2
        self._walk = config.sigma_gyro_bias_walk**2

    def learn(self, error: FloatArray, noise: FloatArray, dt: float) -> None:
        """Take in by how much (3,) rad/s the corrected turn rate over dt (s) exceeds the one seen.

        Noise (3, 3) of both.
        """
        self.covariance = self.covariance + np.eye(3) * (self._walk * dt)
        S = self.covariance + noise
        if float(error @ np.linalg.solve(S, error)) > _GATE:
            return
        gain = np.linalg.solve(S, self.covariance).T
        self.rate = self.rate + gain @ error
        remaining = self.covariance - gain @ S @ gain.T
        self.covariance = 0.5 * (remaining + remaining.T)
