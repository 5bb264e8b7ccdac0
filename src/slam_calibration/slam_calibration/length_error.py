# SPDX-License-Identifier: Apache-2.0
"""By how much a calibrated pair errs in lengths, directions and disparities: what SLAM wants to know of a calibration.

The parameters of a joint calibration are strongly correlated, so their single standard deviations say little: those of
a principal point or of a turn of the right camera are some tenths of a pixel, their common effect on a disparity is
some hundredths. Here the joint covariance is carried through triangulation: pixels stay as they are measured, and the
points that they show move with the parameters (implicit function theorem on the reprojection error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import yaml

from slam_calibration.bundle import POSE, LensState
from slam_calibration.lens import project_with_jacobians
from slam_core.estimation.calibration_error import CalibrationErrorConfig
from slam_core.geometry import FloatArray, skew, transform_points

DISTANCE = 3.0
"""Depth of the points looked at, m: that of features in a room. Errors of disparity grow with it."""
_RAYS = np.linspace(-0.4, 0.4, 5)
"""Grid over the middle of the picture, in widths and heights."""


@dataclass(frozen=True)
class PairError:
    """Standard deviations of a pair's lengths and direction, and of its disparities (px, root mean square)."""

    lengths: CalibrationErrorConfig = CalibrationErrorConfig()
    sigma_disparity: float = 0.0

    @property
    def is_exact(self) -> bool:
        """True if all errors are zero."""
        return self.lengths.is_exact and self.sigma_disparity == 0.0


def pair_error(states: Sequence[LensState], covariance: FloatArray) -> PairError:
    """Standard deviations of what a pair's calibration makes of points at :data:`DISTANCE`.

    Parameters
    ----------
    states
        The pair's cameras, left first.
    covariance
        Joint covariance (k, k) of their parameters and of the right camera's place, as :class:`BundleResult` has it.
    """
    points = _grid(states[0])
    moved = _moved_points(states, points)
    columns = np.concatenate([points[:, :, None], -skew(points)], axis=2).reshape(-1, 4)
    effect = np.linalg.lstsq(columns, moved.reshape(len(columns), -1), rcond=None)[0]
    variances = np.diag(effect @ covariance @ effect.T)
    lengths = CalibrationErrorConfig(float(np.sqrt(variances[0])), float(np.sqrt(variances[1:].mean())))
    # A disparity d = f b / z that is off by e moves its point by -z e / d.
    disparity = states[0].parameters[0] * np.linalg.norm(states[1].T[:3, 3]) / DISTANCE
    off = moved[:, 2] * disparity / DISTANCE
    return PairError(lengths, float(np.sqrt(np.einsum("nk,kl,nl->n", off, covariance, off).mean())))


def parameter_file(error: PairError) -> str:
    """YAML that ``--config`` and nodes take: the deviations for the filter, the joined map and the stereo front end."""
    values = {
        "calibration.sigma_scale": error.lengths.sigma_scale,
        "calibration.sigma_mounting": error.lengths.sigma_mounting,
        "self_calibration.sigma_disparity": error.sigma_disparity,
    }
    return str(yaml.safe_dump({"/**": {"ros__parameters": values}}, sort_keys=False))


def _grid(left: LensState) -> FloatArray:
    u, v = np.meshgrid(_RAYS * left.width / left.parameters[0], _RAYS * left.height / left.parameters[1])
    return DISTANCE * np.column_stack([u.ravel(), v.ravel(), np.ones(u.size)])


def _moved_points(states: Sequence[LensState], points: FloatArray) -> FloatArray:
    """Derivative (n, 3, k) of triangulated points (n, 3) by the parameters, pixels unchanged."""
    lenses = [len(state.parameters) for state in states]
    size, at = sum(lenses) + POSE, 0
    J_points, J_parameters = [], []
    for c, state in enumerate(states):
        R, seen = state.T[:3, :3], transform_points(state.T, points)
        _, J_point, J_lens = project_with_jacobians(state.lens, state.parameters, seen)
        J = np.zeros((len(points), 2, size))
        J[:, :, at : at + lenses[c]] = J_lens
        at += lenses[c]
        if c > 0:
            J[:, :, -POSE:] = J_point @ np.concatenate(
                [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points @ R.T)], axis=2
            )
        J_points.append(J_point @ R)
        J_parameters.append(J)
    A, B = np.concatenate(J_points, axis=1), np.concatenate(J_parameters, axis=1)
    At = np.swapaxes(A, 1, 2)
    return np.asarray(-np.linalg.solve(At @ A, At @ B))
