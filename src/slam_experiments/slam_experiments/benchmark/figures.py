# SPDX-License-Identifier: Apache-2.0
"""Figures of one trajectory against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.evaluation import EXACT_TRUTH, associate, evaluate
from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory
from slam_experiments.benchmark.truth import TRUTH, with_calibration_error

_TRUTH_GAP_S = 0.1
"""True poses are interpolated between neighbours at most this far apart."""


@dataclass(frozen=True)
class Figures:
    """Errors and honesty of one trajectory; None where a figure has no meaning.

    ``ate_mm`` after a rigid alignment, ``scale_percent`` by how much it is too large, ``sigma_over_ate`` claimed
    position sigma over ATE, ``anees_with_truth_errors`` with what ground truth and calibration err besides.
    """

    frames: int
    ate_mm: float
    end_mm: float
    scale_percent: float
    sigma_over_ate: float | None
    anees: float | None
    anees_with_truth_errors: float | None


def figures_of(estimate: Trajectory, truth: Trajectory, known: str) -> Figures:
    """Figures of an estimate; ``known``: name of the truth in :data:`TRUTH`, "" if it is exact.

    Raises
    ------
    ValueError
        If fewer than two poses have a true one.
    """
    matched, true_poses = associate(estimate, truth, _TRUTH_GAP_S, interpolate=True)
    e = evaluate(estimate, truth, interpolate=True, max_difference_s=_TRUTH_GAP_S)
    sigma = with_errors = None
    if matched.covariances is not None:
        sigma = float(np.sqrt(np.mean(np.trace(matched.covariances[:, :3, :3], axis1=1, axis2=2)))) / e.ate.rmse
        accuracy = TRUTH.get(known, EXACT_TRUTH)
        wide = with_calibration_error(estimate) if known in ("kitti", "euroc") else estimate
        with_errors = evaluate(wide, truth, interpolate=True, max_difference_s=_TRUTH_GAP_S, accuracy=accuracy).anees
    scale = scale_percent(matched.poses, true_poses)
    return Figures(len(estimate), 1e3 * e.ate.rmse, 1e3 * e.end_error_m, scale, sigma, e.anees, with_errors)


def scale_percent(estimate: FloatArray, truth: FloatArray) -> float:
    """By how many per cent the estimate (n, 4, 4) is larger than the truth about their centres."""
    sizes = [np.linalg.norm(T[:, :3, 3] - T[:, :3, 3].mean(axis=0)) for T in (estimate, truth)]
    return float(100.0 * (sizes[0] / sizes[1] - 1.0))
