# SPDX-License-Identifier: Apache-2.0
"""Calibration errors: those that stay the same over a run and so never average out.

A filter takes its noise as fresh in every frame. A wrong baseline (or range scale of a ToF camera) instead stretches
all lengths alike, ``t -> (1 + s) t``, and a camera mounted a little turned turns the whole trajectory about the start,
``T -> E T E^-1``. Neither shows in any innovation, so neither can be estimated; their effect on a pose or a landmark is
known exactly, and with it what they add to the covariance (a consider parameter, Schmidt 1966).

They are one and the same in a whole run, so a pose takes them from the start of everything: of its odometry, or of the
joined map. Submaps are handed on without: their errors count as independent in a joined map, and a common error of all
of them, taken as an own one of each, would let every submap turn as it likes (joined maps of simulated rooms became six
times less accurate).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, skew
from slam_core.types import PoseEstimate


@dataclass(frozen=True)
class CalibrationErrorConfig(Config):
    """Standard deviations of a calibration, as the calibration itself reports them."""

    sigma_scale: float = parameter(
        0.0,
        "relative error of all lengths: of the baseline, or of a ToF camera's range",
        minimum=0.0,
        maximum=0.2,
    )
    sigma_mounting: float = parameter(
        0.0, "error of the camera's direction in the rig, each axis", unit="rad", minimum=0.0, maximum=0.5
    )

    @property
    def is_exact(self) -> bool:
        """True if all errors are zero."""
        return self.sigma_scale == 0.0 and self.sigma_mounting == 0.0


def pose_sensitivity(T: FloatArray) -> FloatArray:
    """Change (6, 4) of a pose (4, 4) in the frame of the start, per unit of scale and of the mounting's three turns."""
    J = np.zeros((6, 4))
    J[:3] = np.column_stack([T[:3, 3], -skew(T[:3, 3])])
    J[3:, 1:] = np.eye(3) - T[:3, :3]
    return J


def covariance_of_calibration(T: FloatArray, config: CalibrationErrorConfig) -> FloatArray:
    """Covariance (6, 6) that the calibration's errors give a pose (4, 4) relative to the start of everything."""
    J = pose_sensitivity(T) * _sigmas(config)
    return np.asarray(J @ J.T)


def point_covariances_of_calibration(points: FloatArray, config: CalibrationErrorConfig) -> FloatArray:
    """Covariances (n, 3, 3) that they give points (n, 3) m."""
    J = np.concatenate([points[:, :, None], -skew(points)], axis=2) * _sigmas(config)
    return np.asarray(J @ np.swapaxes(J, 1, 2))


def widened_by_calibration(pose: PoseEstimate, config: CalibrationErrorConfig) -> PoseEstimate:
    """A pose relative to the start of everything, its covariance widened."""
    if config.is_exact:
        return pose
    return replace(pose, covariance=pose.covariance + covariance_of_calibration(pose.T, config))


def _sigmas(config: CalibrationErrorConfig) -> FloatArray:
    return np.array([config.sigma_scale, *[config.sigma_mounting] * 3])
