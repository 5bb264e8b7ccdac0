# SPDX-License-Identifier: Apache-2.0
"""Candidates that a frame may be associated with.

Landmarks and features of the previous frame, as the previous rig pose has them around it.

In this robot-centred form a landmark of the filter and a feature that is not yet a landmark are the same thing: a
point in the previous rig frame, its covariance and its descriptor. What separates the frames is one relative motion
with its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.filtering.measurement_kernels import add_of_points, add_of_pose
from ekf_slam_node.filtering.models import Frame, Observation, increment_jacobian, observe, relative_motion
from slam_core.geometry import FloatArray
from slam_core.types import Float32Array


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points (n, 3) m in the previous rig frame, their covariances (n, 3, 3), descriptors (n, d).

    tracks: (n,) of the front end, by which they were last seen; 0 without one. landmarks: how many of the first are
    landmarks of the filter.
    """

    points: FloatArray
    covariances: FloatArray
    descriptors: Float32Array
    tracks: np.ndarray
    landmarks: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: np.ndarray) -> Candidates:
        """The candidates at ``index``."""
        return Candidates(self.points[index], self.covariances[index], self.descriptors[index], self.tracks[index])

    def places(self, index: np.ndarray) -> Candidates:
        """The candidates at ``index`` without their descriptors, which are the larger part."""
        return Candidates(self.points[index], self.covariances[index], self.descriptors[:0], self.tracks[index])


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """A relative motion ``T`` = T_previous_now (4, 4) with covariance (6, 6), error of ``slam_core.geometry``."""

    T: FloatArray
    covariance: FloatArray


def motion_prior(velocity: FloatArray, velocity_covariance: FloatArray, sigma: FloatArray, dt: float) -> MotionPrior:
    """Constant velocity over dt (s) with acceleration noise sigma (6,)."""
    B = increment_jacobian(np.eye(3), velocity, dt) * dt
    covariance = B @ (velocity_covariance + np.diag(np.square(0.5 * dt * sigma))) @ B.T
    return MotionPrior(relative_motion(velocity, dt), covariance)


def predict(candidates: Candidates, T_previous_now: FloatArray, T_rig_optical: FloatArray, frame: Frame) -> Observation:
    """Candidates as seen after a motion; ``J_pose`` is with respect to the error of ``T_previous_now``."""
    return observe(T_previous_now, T_rig_optical, candidates.points, frame.camera)


def innovation_covariance(
    seen: Observation, candidates: Candidates, motion_covariance: FloatArray | None
) -> FloatArray:
    """S (n, 3, 3) without the feature's own noise: of the motion (None: a motion held fixed) and of the candidates."""
    S = np.zeros((len(candidates), 3, 3))
    add_of_points(seen.J_point, candidates.covariances, S)
    if motion_covariance is not None:
        add_of_pose(seen.J_pose, motion_covariance, S)
    return S
