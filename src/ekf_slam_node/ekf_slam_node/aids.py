# SPDX-License-Identifier: Apache-2.0
"""Motion from elsewhere: scan registration between two frames, the turn rate of an IMU (thesis 9.4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.config import MotionConfig
from ekf_slam_node.gyro_bias import GyroBias
from slam_core.geometry import (
    FloatArray,
    both_halves,
    boxminus,
    compose_covariance,
    interpolate_transform,
    make_transform,
    so3_exp,
    so3_log,
)  # fmt: skip
from slam_core.types import ImuSample, RelativeMotion

_AID_STAMP_TOLERANCE = 0.005
"""Largest difference of the stamps of a motion aid and of the frames it joins."""

ALL = slice(0, 6)
ROTATION = slice(3, 6)


@dataclass(frozen=True, eq=False)
class Aid:
    """A measured motion T = T_previous_now; ``rows`` of its error are known, with their covariance (k, k)."""

    T: FloatArray
    covariance: FloatArray
    rows: slice


class MotionAids:
    """Collects what other sensors say of the motion and sums it up between two frames of the filter.

    Scans need not have the frames' stamps: a scan's motion is taken as even, and the last one goes on for at most its
    own length, with the noise of the constant-velocity model on top.
    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._motions: list[RelativeMotion] = []
        self._samples: list[ImuSample] = []
        self._bias = GyroBias(config)

    def add_motion(self, motion: RelativeMotion) -> bool:
        """Take a motion; False if it is not finite, not positive definite or not forward in time."""
        if not _is_usable(motion):
            return False
        if self._motions and not self._is_same_time(self._motions[-1].end_stamp_ns, motion.start_stamp_ns):
            self._motions = []
        self._motions.append(motion)
        return True

    def add_imu(self, sample: ImuSample) -> bool:
        """Take an IMU reading; False if it is not finite or not newer than the last."""
        newer = not self._samples or sample.stamp_ns > self._samples[-1].stamp_ns
        if not (newer and np.isfinite(sample.angular_velocity).all()):
            return False
        self._samples.append(sample)
        return True

    def between(self, start_stamp_ns: int, end_stamp_ns: int) -> Aid | None:
        """The best aid that covers the time between two stamps, or None."""
        return self._motion_between(start_stamp_ns, end_stamp_ns) or self._rotation_between(
            start_stamp_ns, end_stamp_ns
        )

    def learn_bias(self, aid: Aid, T_previous_now: FloatArray, covariance: FloatArray, dt: float) -> None:
        """Compare an aid from turn rates with the motion that the images alone have shown.

        covariance: (6, 6) along the axes of the previous frame; dt: s.
        """
        if aid.rows != ROTATION:
            return
        R = T_previous_now[:3, :3]
        error = so3_log(R.T @ aid.T[:3, :3]) / dt
        noise = R.T @ covariance[3:, 3:] @ R / dt**2 + np.eye(3) * self._config.sigma_gyro**2
        self._bias.learn(error, noise, dt)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what lies before the frame the filter has reached; the last of it stays, it may go on."""
        older = sum(motion.end_stamp_ns <= stamp_ns for motion in self._motions)
        del self._motions[: max(older - 1, 0)]
        older = sum(sample.stamp_ns <= stamp_ns for sample in self._samples)
        del self._samples[: max(older - 1, 0)]

    # ---- scans
    def _motion_between(self, start_stamp_ns: int, end_stamp_ns: int) -> Aid | None:
        if not self._motions or not self._motions_cover(start_stamp_ns, end_stamp_ns):
            return None
        T, covariance = np.eye(4), np.zeros((6, 6))
        for number, motion in enumerate(self._motions):
            last = number == len(self._motions) - 1
            begin = max(start_stamp_ns, motion.start_stamp_ns)
            end = end_stamp_ns if last else min(end_stamp_ns, motion.end_stamp_ns)
            if end > begin:
                share = (end - begin) / (motion.end_stamp_ns - motion.start_stamp_ns)
                beyond = max(end - motion.end_stamp_ns, 0) * 1e-9
                part = self._part(motion, share, beyond)
                T, covariance = T @ part.T, compose_covariance(T, covariance, part.T, part.covariance)
        return Aid(T, covariance, ALL)

    def _motions_cover(self, start_stamp_ns: int, end_stamp_ns: int) -> bool:
        first, last = self._motions[0], self._motions[-1]
        tolerance = _AID_STAMP_TOLERANCE * 1e9
        reach = last.end_stamp_ns + max(tolerance, last.end_stamp_ns - last.start_stamp_ns)
        return first.start_stamp_ns <= start_stamp_ns + tolerance and end_stamp_ns <= reach

    def _part(self, motion: RelativeMotion, share: float, beyond: float) -> RelativeMotion:
        T = interpolate_transform(np.eye(4), motion.T, np.array(share))
        length = (motion.end_stamp_ns - motion.start_stamp_ns) * 1e-9
        sigma = np.repeat([self._config.sigma_acceleration, self._config.sigma_angular_acceleration], 3)
        noise = np.diag(np.square(sigma * beyond * (beyond + length)))
        return replace(motion, T=T, covariance=motion.covariance * max(share, 1.0) ** 2 + noise)

    # ---- turn rates
    def _rotation_between(self, start_stamp_ns: int, end_stamp_ns: int) -> Aid | None:
        stamps = np.array([sample.stamp_ns for sample in self._samples], dtype=np.int64)
        gap_limit = 0.5 * (end_stamp_ns - start_stamp_ns)
        if len(stamps) < 2 or stamps[0] > start_stamp_ns + gap_limit or stamps[-1] < end_stamp_ns - gap_limit:
            return None
        inside = (stamps > start_stamp_ns) & (stamps < end_stamp_ns)
        edges = np.concatenate([[start_stamp_ns], stamps[inside], [end_stamp_ns]])
        rates = np.array([sample.angular_velocity for sample in self._samples])
        middle = 0.5 * (edges[1:] + edges[:-1]) - start_stamp_ns
        times = (stamps - start_stamp_ns).astype(np.float64)
        at_middle = np.column_stack([np.interp(middle, times, rates[:, axis]) for axis in range(3)]) - self._bias.rate
        rotation = np.eye(3)
        for step in so3_exp(at_middle * np.diff(edges)[:, None] * 1e-9):
            rotation = rotation @ step
        dt = (end_stamp_ns - start_stamp_ns) * 1e-9
        variance = np.eye(3) * self._config.sigma_gyro**2 + self._bias.covariance
        return Aid(make_transform(rotation, np.zeros(3)), variance * dt**2, ROTATION)

    def _is_same_time(self, a: int, b: int) -> bool:
        return abs(a - b) <= _AID_STAMP_TOLERANCE * 1e9


def aid_error(aid: Aid, T_previous_now: FloatArray, rotation_map_previous: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Error (k,) of a motion as an aid sees it, along the map's axes, and its covariance (k, k)."""
    error = np.concatenate([aid.T[:3, 3] - T_previous_now[:3, 3], so3_log(aid.T[:3, :3] @ T_previous_now[:3, :3].T)])
    turn = both_halves(rotation_map_previous)
    rows = turn[aid.rows, aid.rows]
    return (turn @ error)[aid.rows], rows @ aid.covariance @ rows.T


def contradicts(aid: Aid, T_previous_now: FloatArray, covariance: FloatArray, gate: float) -> bool:
    """True if an aid lies beyond the gate of a motion found otherwise, with its covariance (6, 6).

    Scan registration that has slid along a wall is as wrong as it is sure of itself, and only vision can tell.
    """
    error = boxminus(aid.T, T_previous_now)[aid.rows]
    S = aid.covariance + covariance[aid.rows, aid.rows]
    return not float(error @ np.linalg.solve(S, error)) < gate


def _is_usable(motion: RelativeMotion) -> bool:
    finite = np.isfinite(motion.T).all() and np.isfinite(motion.covariance).all()
    return bool(
        finite and motion.end_stamp_ns > motion.start_stamp_ns and np.linalg.eigvalsh(motion.covariance)[0] > 0.0
    )
