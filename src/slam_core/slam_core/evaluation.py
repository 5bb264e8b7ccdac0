# SPDX-License-Identifier: Apache-2.0
"""Accuracy of a trajectory and honesty of its covariance: ATE, RPE, drift and NEES.

ATE and RPE follow Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), as evo computes
them; NEES and its chi-square bounds follow Bar-Shalom, Li and Kirubarajan (2001), section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.estimation.body_frame import body_offset
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, both_halves, boxminus, invert_transform, skew, so3_log
from slam_core.trajectory import Trajectory

ALIGNMENTS = ("se3", "origin", "none")


@dataclass(frozen=True)
class TruthAccuracy:
    """Standard deviations of ground truth itself, per axis and pose: position (m) and orientation (rad).

    Errors of different poses count as independent; of a drift inside the truth this knows nothing.
    """

    position: float = 0.0
    rotation: float = 0.0

    def __post_init__(self) -> None:
        if not (self.position >= 0.0 and self.rotation >= 0.0 and np.isfinite([self.position, self.rotation]).all()):
            raise ValueError(
                f"accuracy of ground truth must be finite and not negative, got {self.position} m, {self.rotation} rad"
            )

    def of_poses_from_start(self, poses: FloatArray) -> FloatArray:
        """Covariances (n, 6, 6) of poses (n, 4, 4) relative to the start, whose own true pose is no better.

        The start's error in direction swings a pose that is far away: ``d_t = d_rotation x t``.
        """
        sigma = np.repeat([self.position, self.rotation], 3)
        J = np.tile(np.eye(6), (len(poses), 1, 1))
        J[:, :3, 3:] = -skew(poses[:, :3, 3])
        return np.asarray((J * sigma**2) @ np.swapaxes(J, 1, 2) + np.diag(sigma**2))


EXACT_TRUTH = TruthAccuracy()


@dataclass(frozen=True)
class ErrorStatistics:
    """Root mean square, mean, median, standard deviation, smallest and largest of a set of errors, and how many."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorStatistics:
        """Statistics of errors (n,), n >= 1."""
        if len(errors) == 0:
            raise ValueError("no errors to summarise: estimate and ground truth share no stamps")
        return cls(
            float(np.sqrt(np.mean(np.square(errors)))),
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.std(errors)),
            float(np.min(errors)),
            float(np.max(errors)),
            len(errors),
        )


def associate(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = 0.01, interpolate: bool = False
) -> tuple[Trajectory, FloatArray]:
    """The estimates that ground truth covers, and the true poses (n, 4, 4) that belong to them.

    A pose belongs to the nearest true one in time, at most ``max_difference_s`` away; with ``interpolate`` the truth is
    interpolated between its two neighbours where these are that far apart at most.

    Raises
    ------
    ValueError
        If fewer than two poses can be compared; the message gives both time spans.
    """
    stamps, limit = estimate.stamps_ns, int(max_difference_s * 1e9)
    after = np.clip(np.searchsorted(truth.stamps_ns, stamps), 1, max(len(truth) - 1, 1)) if len(truth) > 1 else None
    if after is None:
        nearest = np.zeros(len(stamps), dtype=np.intp)
    else:
        closer = np.abs(truth.stamps_ns[after] - stamps) < np.abs(truth.stamps_ns[after - 1] - stamps)
        nearest = np.where(closer, after, after - 1)
    supported = np.abs(truth.stamps_ns[nearest] - stamps) <= limit
    if interpolate and after is not None:
        inside = (stamps >= truth.stamps_ns[after - 1]) & (stamps <= truth.stamps_ns[after])
        supported |= inside & (truth.stamps_ns[after] - truth.stamps_ns[after - 1] <= limit)
    if supported.sum() < 2:
        spans = [f"{t.stamps_ns[0] / 1e9:.3f} to {t.stamps_ns[-1] / 1e9:.3f} s" for t in (estimate, truth) if len(t)]
        raise ValueError(
            f"estimate and ground truth ({' and '.join(spans)}) have fewer than two poses within {max_difference_s} s"
        )
    poses = truth.interpolate(stamps[supported]) if interpolate else truth.poses[nearest[supported]]
    return estimate.select(supported), poses


def align(estimate: FloatArray, truth: FloatArray, alignment: str = "se3") -> FloatArray:
    """Estimated poses (n, 4, 4) moved into the frame of the true ones.

    "se3": the least-squares rigid transform of the positions (what evo's ``--align`` does); "origin": so that the first
    poses agree; "none": unchanged.
    """
    if alignment == "se3":
        if len(estimate) < 3:
            return align(estimate, truth, "origin")
        return np.asarray(umeyama(estimate[:, :3, 3], truth[:, :3, 3]) @ estimate)
    if alignment == "origin":
        return np.asarray(truth[0] @ invert_transform(estimate[0]) @ estimate)
    if alignment == "none":
        return estimate
    raise ValueError(f"alignment must be one of {', '.join(ALIGNMENTS)}, got '{alignment}'")


def absolute_errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (m) and angles (rad), each (n,), between poses (n, 4, 4) of a common frame."""
    d = boxminus(estimate, truth)
    return np.linalg.norm(d[:, :3], axis=1), np.linalg.norm(d[:, 3:], axis=1)


def relative_errors(estimate: FloatArray, truth: FloatArray, delta: int = 1) -> tuple[FloatArray, FloatArray]:
    """RPE over ``delta`` frames, ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)``: translations m, angles rad, each (n - delta,)."""
    if not 1 <= delta < len(estimate):
        raise ValueError(f"delta must be between 1 and {len(estimate) - 1} frames, got {delta}")
    moved = invert_transform(estimate[:-delta]) @ estimate[delta:]
    truly = invert_transform(truth[:-delta]) @ truth[delta:]
    error = invert_transform(truly) @ moved
    return np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(so3_log(error[:, :3, :3]), axis=1)


def end_error(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Distance (m) and angle (rad) of the last pose from the truth when the first poses agree."""
    distance, angle = absolute_errors(align(estimate, truth, "origin")[-1:], truth[-1:])
    return float(distance[0]), float(angle[0])


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised estimation error squared ``e' P^-1 e``; error (..., d), covariance (..., d, d)."""
    return np.asarray(np.einsum("...i,...i->...", error, np.linalg.solve(covariance, error[..., None])[..., 0]))


def pose_nees(estimate: Trajectory, truth: FloatArray, accuracy: TruthAccuracy = EXACT_TRUTH) -> FloatArray:
    """NEES (m,) of the poses whose covariance is positive definite, with the first poses made to agree.

    The frame of a SLAM map is its first pose, known exactly, so the comparison aligns there and nowhere else. The error
    of ground truth, in the first pose and in the others, adds to the covariance.
    """
    if estimate.covariances is None:
        raise ValueError("NEES needs covariances")
    in_map = estimate.poses[0] @ invert_transform(truth[0]) @ truth
    usable = np.linalg.eigvalsh(estimate.covariances)[:, 0] > 1e-14
    usable[0] = False
    from_start = invert_transform(estimate.poses[:1]) @ estimate.poses
    turn = both_halves(estimate.poses[0, :3, :3])
    covariances = estimate.covariances + turn @ accuracy.of_poses_from_start(from_start) @ turn.T
    return nees(boxminus(in_map[usable], estimate.poses[usable]), covariances[usable])


def anees_bounds(dimension: int, samples: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval in which the average NEES per dimension of ``samples`` independent errors lies with this confidence."""
    if dimension < 1 or samples < 1:
        raise ValueError(f"dimension and samples must be positive, got {dimension} and {samples}")
    freedom = dimension * samples
    tail = (1.0 - confidence) / 2.0
    return chi_square_bound(tail, freedom) / freedom, chi_square_bound(1.0 - tail, freedom) / freedom


@dataclass(frozen=True)
class Evaluation:
    """All figures of one trajectory against ground truth; m and deg. ``anees`` is None without covariances."""

    ate: ErrorStatistics
    ate_rotation_deg: ErrorStatistics
    rpe: ErrorStatistics
    rpe_rotation_deg: ErrorStatistics
    end_error_m: float
    end_error_deg: float
    drift_percent: float
    truth_length_m: float
    anees: float | None
    anees_low: float | None
    anees_high: float | None
    body_offset: list[list[float]] | None = None
    """T_estimate_truth (4, 4) between body frames that differ by a constant; None where they are the same."""
    body_aligned: bool = False


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    alignment: str = "se3",
    delta: int = 1,
    max_difference_s: float = 0.01,
    interpolate: bool = False,
    accuracy: TruthAccuracy = EXACT_TRUTH,
    align_body: bool = False,
) -> Evaluation:
    """Compare a trajectory with ground truth.

    A constant difference of the body frames is found where there is one, and taken off the truth with ``align_body``.
    The ANEES bounds assume independent poses, which those of one run are not: it is an indication, over many a test.
    """
    matched, true_poses = associate(estimate, truth, max_difference_s, interpolate)
    offset = body_offset(matched.poses, true_poses)
    if align_body and offset is not None:
        true_poses = true_poses @ invert_transform(offset)
    distance, angle = absolute_errors(align(matched.poses, true_poses, alignment), true_poses)
    step, turn = relative_errors(matched.poses, true_poses, min(delta, len(matched) - 1))
    length = Trajectory(matched.stamps_ns, true_poses).length_m
    end, end_angle = end_error(matched.poses, true_poses)
    anees, anees_low, anees_high = _anees(matched, true_poses, accuracy)
    return Evaluation(
        ate=ErrorStatistics.of(distance),
        ate_rotation_deg=ErrorStatistics.of(np.rad2deg(angle)),
        rpe=ErrorStatistics.of(step),
        rpe_rotation_deg=ErrorStatistics.of(np.rad2deg(turn)),
        end_error_m=end,
        end_error_deg=float(np.rad2deg(end_angle)),
        drift_percent=100.0 * end / length if length > 0 else 0.0,
        truth_length_m=length,
        anees=anees,
        anees_low=anees_low,
        anees_high=anees_high,
        body_offset=None if offset is None else offset.tolist(),
        body_aligned=align_body and offset is not None,
    )


def _anees(
    matched: Trajectory, true_poses: FloatArray, accuracy: TruthAccuracy
) -> tuple[float, float, float] | tuple[None, None, None]:
    """ANEES and its bounds, or None where the trajectory has no covariances."""
    values = np.empty(0) if matched.covariances is None else pose_nees(matched, true_poses, accuracy)
    if not len(values):
        return None, None, None
    return float(np.mean(values) / 6.0), *anees_bounds(6, len(values))
