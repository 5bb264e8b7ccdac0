# SPDX-License-Identifier: Apache-2.0
"""Poses of an external odometry between two stamps, and what noise each step of it has.

The variance of a step is, axis by axis, what the reported covariances say: by how much the pose's covariance has grown,
else the twist's. Where neither can be used (zero, huge, not finite, shrinking) a model of wheels on a floor stands in,
whose size the images then tell (:mod:`external_odometry`).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from slam_core.geometry import (
    FloatArray,
    boxminus,
    compose_jacobians,
    interpolate_transform,
    invert_transform,
)
from slam_core.types import OdometryReading

_LONGEST_GAP_S = 0.5
"""Readings farther apart than this say nothing of what was between them."""
_FASTEST = np.repeat([20.0, 15.0], 3)
"""Speeds (m/s, rad/s) beyond which a pose has jumped: a driver was started anew."""
_SMALLEST_VARIANCE, _LARGEST_VARIANCE = 1e-14, 1e2
"""Of a step (m2, rad2): outside nothing is claimed."""
_PER_METRE = np.array([0.01, 0.01, 0.005, np.radians(0.3), np.radians(0.3), np.radians(0.5)]) ** 2
"""Variance that a metre of way adds, m2 and rad2."""
_PER_RADIAN = np.array([0.005, 0.005, 0.0, 0.0, 0.0, 0.02]) ** 2
"""Variance that a radian of turning adds."""
_PER_SECOND = np.array([5e-4, 5e-4, 5e-4, *np.radians([0.02, 0.02, 0.02])]) ** 2


class PoseReadings:
    """The newest readings of one odometry, in the order of their stamps."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._readings: list[OdometryReading] = []
        self._variance: list[FloatArray] = []
        """Sum (6,) of the steps' variances up to each reading, along the frame's axes."""
        self.claimed = np.zeros(6, dtype=bool)
        """Axes (6,) of which the newest step's covariance could be used."""

    @property
    def newest(self) -> OdometryReading | None:
        """The newest reading, if any."""
        return self._readings[-1] if self._readings else None

    def add(self, reading: OdometryReading) -> str:
        """Take a reading; returns why it is rejected, or "". After a jump, or a long gap, all begins anew."""
        if not np.isfinite(reading.T).all():
            return "not finite"
        if not self._readings:
            return self._begin(reading)
        before = self._readings[-1]
        dt = (reading.stamp_ns - before.stamp_ns) * 1e-9
        if dt <= 0.0:
            return "not newer than the last"
        step = invert_transform(before.T) @ reading.T
        if dt > _LONGEST_GAP_S or reading.frame_id != before.frame_id:
            return self._begin(reading)
        if (np.abs(boxminus(step, np.eye(4))) > _FASTEST * max(dt, 0.01)).any():
            self._begin(reading)
            return "jumped"
        self._append(reading, self._variance[-1] + self._step_variance(before, reading, step, dt))
        return ""

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """True if there are readings from one stamp to the other."""
        return bool(self._stamps) and self._stamps[0] <= start_ns < end_ns <= self._stamps[-1]

    def motion(self, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
        """Motion (4, 4) of the frame between two stamps that are covered, and its variances (6,) as claimed."""
        (T0, variance0), (T1, variance1) = self._at(start_ns), self._at(end_ns)
        return invert_transform(T0) @ T1, variance1 - variance0

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the readings before a stamp but for the last of them."""
        older = bisect_right(self._stamps, stamp_ns) - 1
        if older > 0:
            del self._stamps[:older], self._readings[:older], self._variance[:older]

    def _begin(self, reading: OdometryReading) -> str:
        self._stamps, self._readings, self._variance = [], [], []
        self._append(reading, np.zeros(6))
        return ""

    def _append(self, reading: OdometryReading, variance: FloatArray) -> None:
        self._stamps.append(reading.stamp_ns)
        self._readings.append(reading)
        self._variance.append(variance)

    def _at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        after = min(max(bisect_left(self._stamps, stamp_ns), 1), len(self._stamps) - 1)
        first, second = self._stamps[after - 1], self._stamps[after]
        share = (stamp_ns - first) / (second - first)
        T = interpolate_transform(self._readings[after - 1].T, self._readings[after].T, np.array(share))
        return T, (1.0 - share) * self._variance[after - 1] + share * self._variance[after]

    def _step_variance(
        self, before: OdometryReading, after: OdometryReading, step: FloatArray, dt: float
    ) -> FloatArray:
        grown = _growth(before, after, step)
        twist = np.diagonal(after.twist_covariance) * dt**2
        way, turn = np.linalg.norm(step[:3, 3]), np.linalg.norm(boxminus(step, np.eye(4))[3:])
        model = _PER_METRE * way + _PER_RADIAN * turn + _PER_SECOND * dt
        moves = way > 1e-6 or turn > 1e-6
        by_growth, by_twist = _is_claim(grown), _is_claim(twist)
        if moves:  # one that stands may well claim nothing
            self.claimed = by_growth | by_twist
        return np.where(by_growth, grown, np.where(by_twist, twist, model))


def _growth(before: OdometryReading, after: OdometryReading, step: FloatArray) -> FloatArray:
    """By how much (6,) the covariance has grown, along the axes of the frame before."""
    if min(np.diagonal(r.covariance).min() for r in (before, after)) < 0.0:
        return np.full(6, np.nan)
    J_before, J_step = compose_jacobians(before.T, step)
    with np.errstate(invalid="ignore", over="ignore"):
        grown = after.covariance - J_before @ before.covariance @ J_before.T
        return np.asarray(np.diagonal(J_step.T @ grown @ J_step))


def _is_claim(variance: FloatArray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.asarray((variance > _SMALLEST_VARIANCE) & (variance < _LARGEST_VARIANCE))
