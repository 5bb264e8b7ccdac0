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
from ekf_slam_node.association.rig_motion_kernels import best_sample_of_rig
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.models import Frame, rig_points
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
    if frame.cameras:
        return _best_sample_of_rig(candidates, frame, T_rig_optical, rng.random((hypotheses, 3)), initial)
    optical_rig = invert_transform(T_rig_optical)
    first = np.zeros((0, 4, 4)) if initial is None else (optical_rig @ invert_transform(initial) @ T_rig_optical)[None]
    T_now_previous = best_sample(
        candidates.points, candidates.covariances, frame.z, frame.variance, T_rig_optical, frame.camera.lens,
        rng.random((hypotheses, 3)), first, _SAMPLE_GATE,
    )  # fmt: skip
    return T_rig_optical @ invert_transform(T_now_previous) @ optical_rig


def _best_sample_of_rig(
    candidates: Candidates, frame: Frame, T_rig_optical: FloatArray, draws: FloatArray, initial: FloatArray | None
) -> FloatArray:
    """The best sample of pairs of several cameras, which share one motion of the rig."""
    parts = frame.parts(T_rig_optical)
    first = np.zeros((0, 4, 4)) if initial is None else invert_transform(initial)[None]
    spread = np.empty((len(frame), 2))
    for index, _, T in parts:
        own = np.einsum("ji,njk,ki->ni", T[:3, :3], candidates.covariances[index], T[:3, :3])
        spread[index] = np.column_stack([0.5 * (own[:, 0] + own[:, 1]), own[:, 2]])
    now, _ = rig_points(frame, T_rig_optical)
    T_optical_rig, lenses = np.stack([invert_transform(p.T_rig_optical) for p in parts]), [p.camera.lens for p in parts]
    return invert_transform(
        best_sample_of_rig(
            candidates.points, now, spread, frame.z, frame.variance, T_optical_rig, np.stack(lenses), frame.seen_by,
            draws, first, _SAMPLE_GATE,
        )
    )  # fmt: skip


def refine_motion(
    candidates: Candidates, frame: Frame, T_rig_optical: FloatArray, T: FloatArray, gate: float, iterations: int = 8
) -> MotionGuess | None:
    """Gauss-Newton on the pairs inside the gate, chosen anew in each step, the gate closing from wide to its value.

    The spread of the pairs' errors tells how much larger they are than claimed (``variance_scale``); gate and weights
    follow.
    """
    order = np.argsort(frame.seen_by, kind="stable") if frame.cameras else None
    if order is not None:  # camera by camera
        candidates, frame = candidates.places(order), frame.places(order)
    parts, pairs = frame.parts(T_rig_optical), PairErrors.room(len(candidates))
    mountings, lenses = np.stack([part.T_rig_optical for part in parts]), np.stack([p.camera.lens for p in parts])
    ends = np.searchsorted(frame.seen_by, np.arange(len(parts)), side="right")
    found, T, covariance, inliers, variance_scale = refined(
        candidates.points, candidates.covariances, frame.z, frame.variance, mountings, lenses, ends,
        T, gate, iterations, pairs.error, pairs.S, pairs.J, pairs.depth,
    )  # fmt: skip
    if not found:
        return None
    error = pairs.error
    if order is not None:
        back = np.argsort(order, kind="stable")
        inliers, error = inliers[back], error[back]
    return MotionGuess(T, covariance, inliers, variance_scale, error)
