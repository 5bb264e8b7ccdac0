# SPDX-License-Identifier: Apache-2.0
"""The motion between two frames from paired points: random samples, then least squares on what agrees.

Used in two ways. With pairs that a prediction has gated it rejects what moves on its own, reflections and repeated
texture: the rig's motion is the one that most of the scene agrees with. With pairs by descriptor alone it finds a
motion that no prediction expects: large steps, low frame rates, after a blackout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.association.motion_kernels import best_sample, refined
from ekf_slam_node.association.pair_kernels import PairErrors
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.models import Frame
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, invert_transform

_SAMPLE_GATE = 4.0 * chi_square_bound(0.95, 3)
"""Squared error that a sample must explain to count in full: 95 % of true pairs have less, at twice the standard
deviation, because three points alone do not give the best motion.
"""


@dataclass(frozen=True, eq=False)
class MotionGuess:
    """A motion guessed from pairs, and the pairs that agree with it.

    T: T_previous_now (4, 4); covariance: (6, 6), of the pairs alone; inliers: mask of the pairs that agree (n,); the
    factors (3,) by which their errors exceed the claimed variances; error: (n, 3), measured less predicted, of all
    pairs.
    """

    T: FloatArray
    covariance: FloatArray
    inliers: np.ndarray
    variance_scale: FloatArray
    error: FloatArray


def guess_motion(
    candidates: Candidates,
    frame: Frame,
    T_rig_optical: FloatArray,
    rng: np.random.Generator,
    hypotheses: int,
    gate: float,
    initial: FloatArray | None = None,
) -> MotionGuess | None:
    """Motion of paired candidates and features (same length, row by row); None where too few pairs agree.

    ``initial`` competes with the samples.
    """
    if len(candidates) < 4:
        return None
    T = _best_sample(candidates, frame, T_rig_optical, rng, hypotheses, initial)
    return refine_motion(candidates, frame, T_rig_optical, T, gate)


def _best_sample(
    candidates: Candidates,
    frame: Frame,
    T_rig_optical: FloatArray,
    rng: np.random.Generator,
    hypotheses: int,
    initial: FloatArray | None,
) -> FloatArray:
    optical_rig = invert_transform(T_rig_optical)
    first = np.zeros((0, 4, 4)) if initial is None else (optical_rig @ invert_transform(initial) @ T_rig_optical)[None]
    T_now_previous = best_sample(
        candidates.points, candidates.covariances, frame.z, frame.variance, T_rig_optical, frame.camera.lens,
        rng.random((hypotheses, 3)), first, _SAMPLE_GATE,
    )  # fmt: skip
    return T_rig_optical @ invert_transform(T_now_previous) @ optical_rig


def refine_motion(
    candidates: Candidates, frame: Frame, T_rig_optical: FloatArray, T: FloatArray, gate: float, iterations: int = 8
) -> MotionGuess | None:
    """Gauss-Newton on the pairs inside the gate, chosen anew in each step, the gate closing from wide to its value.

    The spread of the pairs' errors tells how much larger they are than claimed (``variance_scale``); gate and weights
    follow.
    """
    pairs = PairErrors.room(len(candidates))
    found, T, covariance, inliers, variance_scale = refined(
        candidates.points, candidates.covariances, frame.z, frame.variance, T_rig_optical, frame.camera.lens,
        T, gate, iterations, pairs.error, pairs.S, pairs.J, pairs.depth,
    )  # fmt: skip
    return MotionGuess(T, covariance, inliers, variance_scale, pairs.error) if found else None
