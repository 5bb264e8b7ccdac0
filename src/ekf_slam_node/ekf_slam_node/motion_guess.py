# SPDX-License-Identifier: Apache-2.0
"""The motion between two frames from paired points: random samples, then least squares on what agrees.

Used in two ways. With pairs that a prediction has gated it rejects what moves on its own, reflections and repeated
texture: the rig's motion is the one that most of the scene agrees with. With pairs by descriptor alone it finds a
motion that no prediction expects: large steps, low frame rates, after a blackout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ekf_slam_node.candidates import Candidates
from ekf_slam_node.models import Frame, rig_points
from ekf_slam_node.pair_kernels import PairErrors, gated, normal_equations, pair_errors
from slam_core.camera import MIN_DEPTH
from slam_core.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxplus, invert_transform
from slam_core.rigid_alignment import umeyama

_SAMPLE_GATE = 4.0 * chi_square_bound(0.95, 3)
"""Squared error that a sample must explain to count in full: 95 % of true pairs have less, at twice the standard
deviation, because three points alone do not give the best motion.
"""

_MEDIAN_CHI2 = 0.4549
"""Median of chi-square with one degree of freedom."""

_MAX_EXCESS = 25.0


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
    excess: FloatArray
    error: FloatArray


@njit(cache=True, nogil=True)
def _score(T, points, lateral, along, z, variance, fx, fy, cx, cy, gate):  # type: ignore[no-untyped-def]
    """Truncated cost (MSAC, Torr and Zisserman 2000) of each motion T_optical_now_previous."""
    costs = np.zeros(len(T))
    for h in range(len(T)):
        total = 0.0
        M = T[h]
        for i in range(len(points)):
            x = M[0, 0] * points[i, 0] + M[0, 1] * points[i, 1] + M[0, 2] * points[i, 2] + M[0, 3]
            y = M[1, 0] * points[i, 0] + M[1, 1] * points[i, 1] + M[1, 2] * points[i, 2] + M[1, 3]
            d = M[2, 0] * points[i, 0] + M[2, 1] * points[i, 1] + M[2, 2] * points[i, 2] + M[2, 3]
            if d < MIN_DEPTH:
                total += gate
                continue
            w = 1.0 / d
            du, dv, dw = z[i, 0] - fx * x * w - cx, z[i, 1] - fy * y * w - cy, z[i, 2] - w
            su = variance[i, 0] + lateral[i] * (fx * w) ** 2
            sv = variance[i, 1] + lateral[i] * (fy * w) ** 2
            sw = variance[i, 2] + along[i] * w**4
            total += min(du * du / su + dv * dv / sv + dw * dw / sw, gate)
        costs[h] = total
    return costs


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
    n = len(candidates)
    now, _ = rig_points(frame, T_rig_optical)
    samples = np.argpartition(rng.random((hypotheses, n)), 2, axis=1)[:, :3]
    motions = umeyama(now[samples], candidates.points[samples])
    if initial is not None:
        motions = np.concatenate([initial[None], motions])
    optical_previous = invert_transform(T_rig_optical)
    R = optical_previous[:3, :3]
    points = candidates.points @ R.T + optical_previous[:3, 3]
    spread = np.einsum("ij,njk,ik->ni", R, candidates.covariances, R)
    T = optical_previous @ invert_transform(motions) @ T_rig_optical
    c = frame.camera
    costs = _score(
        T,
        points,
        0.5 * (spread[:, 0] + spread[:, 1]),
        spread[:, 2],
        frame.z,
        frame.variance,
        c.fx,
        c.fy,
        c.cx,
        c.cy,
        _SAMPLE_GATE,
    )
    return np.asarray(motions[int(np.argmin(costs))])


def refine_motion(
    candidates: Candidates, frame: Frame, T_rig_optical: FloatArray, T: FloatArray, gate: float, iterations: int = 8
) -> MotionGuess | None:
    """Gauss-Newton on the pairs inside the gate, chosen anew in each step, the gate closing from wide to its value.

    The spread of the pairs' errors tells how much larger they are than claimed (``excess``); gate and weights follow.
    """
    covariance, excess, trusted = np.eye(6), np.ones(3), np.ones(3)
    inliers = np.zeros(len(candidates), dtype=bool)
    c = frame.camera
    lens = np.array([c.fx, c.fy, c.cx, c.cy])
    pairs = PairErrors.room(len(candidates))
    for step in range(iterations):
        pair_errors(
            candidates.points, candidates.covariances, frame.z, frame.variance, T @ T_rig_optical, T[:3, 3], lens,
            pairs.error, pairs.S, pairs.J, pairs.depth,
        )  # fmt: skip
        root = np.sqrt(trusted)
        updated = gated(pairs.error, pairs.S, pairs.depth, root, gate * max(1.0, 4.0 - step))
        if updated.sum() < 4:
            return None
        if step > 3 and np.array_equal(updated, inliers):
            break
        inliers = updated
        excess = _excess(pairs.error[inliers], pairs.S[inliers])
        trusted = np.maximum(excess, 1.0)
        information, gradient = normal_equations(pairs.error, pairs.S, pairs.J, inliers, np.sqrt(trusted))
        try:
            covariance = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            return None
        T = boxplus(T, covariance @ gradient)
    return MotionGuess(T, 0.5 * (covariance + covariance.T), inliers, excess, pairs.error)


def _excess(error: FloatArray, S: FloatArray) -> FloatArray:
    """By how much the median squares of pixel and inverse depth errors exceed their variances (3,)."""
    ratio = error**2 / S[:, np.arange(3), np.arange(3)] / _MEDIAN_CHI2
    pixels, depth = _median(ratio[:, :2].ravel()), _median(ratio[:, 2])
    return np.asarray(np.clip([pixels, pixels, depth], 0.25, _MAX_EXCESS))


def _median(values: FloatArray) -> float:
    """``np.median`` of at least one number, without its tests and copies, which took a millisecond a frame."""
    ordered = np.sort(values)
    n = len(ordered)
    return float(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))
