# SPDX-License-Identifier: Apache-2.0
"""Motion of an IMU between two stamps, summed up from its readings alone (preintegration, Forster et al. 2017).

Neither velocity nor gravity is needed for it, so that these may stay unknowns of a filter. Along the axes of the start:

    R = prod Exp((w - b_g) dt),   v = sum R (f - b_a) dt,   p = sum (v dt + R (f - b_a) dt^2 / 2)

are the turn, the change of velocity and the way that a free fall would not explain; their errors (6 + 3, in this order
of turn, v, p) depend linearly on those of the biases, and of the clock: readings stamped too early by e are those of
a window that lies e later, so that the error is e times

    w0 - R w1,   w0 x v + f0 - R f1,   w0 x p + f0 dt - v

with rates w and forces f at the window's start (0) and end (1).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import isfinite

import numpy as np

from ekf_slam_node.odometry.preintegration_kernels import preintegrated
from slam_core.geometry import FloatArray
from slam_core.tags import IntArray
from slam_core.types import LONGEST_IMU_STEP_S, ImuSample

_EDGE_NS = 20_000_000
"""Readings at an edge are means over so long: one's noise would be taken for a change of the rates."""
_AROUND_NS = 0.5 * _EDGE_NS * np.linspace(-1.0, 1.0, 9)
_LONGEST_S = 10.0
"""Nothing is integrated over longer times, and readings are kept for twice as long."""


@dataclass(frozen=True)
class ImuNoise:
    """White noise of the readings, gyro rad/s/sqrt(Hz) and accelerometer m/s2/sqrt(Hz).

    ``unknown_turn`` rad/s and ``unknown_force`` m/s2: standard deviations where readings are missing.
    """

    gyro: float
    accelerometer: float
    unknown_turn: float
    unknown_force: float

    @property
    def values(self) -> FloatArray:
        """The four, (4,)."""
        return np.array([self.gyro, self.accelerometer, self.unknown_turn, self.unknown_force])


@dataclass(frozen=True, eq=False)
class Preintegral:
    """Turn R (3, 3), change of velocity v (3,) m/s, way p (3,) m over dt (s).

    J: (9, 7) derivative of the errors of (turn, v, p) with respect to the biases (gyroscope, accelerometer) and to
    what is to be added to the stamps, s.
    clock_turns: (2, 3) derivative of the turn with respect to these, by either half of the readings at the edges.
    covariance: (9, 9) of the errors' noise. force: (3,) mean specific force along the axes of the start, m/s2. reading:
    mean size of it as it was read, biases included.
    """

    dt: float
    R: FloatArray
    v: FloatArray
    p: FloatArray
    J: FloatArray
    clock_turns: FloatArray
    covariance: FloatArray
    force: FloatArray
    reading: float


class ImuReadings:
    """The newest readings along the rig's axes, in the order of their stamps."""

    def __init__(self) -> None:
        self._samples: deque[ImuSample] = deque()

    def add(self, sample: ImuSample) -> bool:
        """Take a reading; False if it is not finite or not newer than the last."""
        newer = not self._samples or sample.stamp_ns > self._samples[-1].stamp_ns
        values = (*sample.angular_velocity.tolist(), *sample.linear_acceleration.tolist())
        if not newer or not all(map(isfinite, values)):
            return False
        self._samples.append(sample)
        self.forget_before(sample.stamp_ns - round(2e9 * _LONGEST_S))
        return True

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the readings before a stamp but for the last of them."""
        while len(self._samples) > 1 and self._samples[1].stamp_ns <= stamp_ns:
            self._samples.popleft()

    @property
    def newest(self) -> ImuSample | None:
        """The newest reading, if any."""
        return self._samples[-1] if self._samples else None

    def integrate(self, start_ns: int, end_ns: int, biases: FloatArray, noise: ImuNoise) -> Preintegral | None:
        """Preintegral between two stamps with biases (6,); None where there are none of both, or over long times."""
        stamps = np.array([sample.stamp_ns for sample in self._samples], dtype=np.int64)
        gap_limit = 0.5 * (end_ns - start_ns)
        if len(stamps) < 2 or stamps[0] > start_ns + gap_limit or stamps[-1] < end_ns - gap_limit:
            return None
        if not 0 < end_ns - start_ns <= _LONGEST_S * 1e9:
            return None
        rates = np.array([sample.angular_velocity for sample in self._samples], dtype=np.float64)
        forces = np.array([sample.linear_acceleration for sample in self._samples], dtype=np.float64)
        R, v, p, J, covariance = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((9, 7)), np.empty((9, 9))
        size = preintegrated(
            stamps, rates, forces, np.array([start_ns, end_ns]), biases, noise.values, LONGEST_IMU_STEP_S,
            R, v, p, J[:, :6], covariance,
        )  # fmt: skip
        dt = 1e-9 * (end_ns - start_ns)
        both, edges = np.column_stack([rates, forces]) - biases, np.array([start_ns, end_ns])
        around, times = (edges - start_ns)[:, None] + _AROUND_NS, (stamps - start_ns).astype(np.float64)
        at_edges = np.stack([np.interp(around, times, column).mean(axis=1) for column in both.T], axis=1)
        J[:, 6] = _clock_jacobian(R, v, p, at_edges, dt)
        halves = np.stack([_halves_before(stamps, both, edge_ns) for edge_ns in edges.tolist()], axis=1)
        clock_turns = np.array([_clock_jacobian(R, v, p, half, dt)[:3] for half in halves])
        return Preintegral(dt, R, v, p, J, clock_turns, covariance, v / dt, size)


def _halves_before(stamps: IntArray, readings: FloatArray, edge_ns: int) -> FloatArray:
    """Two means (2, 6) of readings (n, 6) before an edge that share none; the nearest for both where they are sparse.

    Later readings may not have come yet at the end; by a common lag both edges tell of a window that much earlier.
    """
    chosen = np.flatnonzero((stamps > edge_ns - _EDGE_NS) & (stamps <= edge_ns))
    if len(chosen) < 2:
        nearest = readings[np.argmin(np.abs(stamps - edge_ns))]
        return np.array([nearest, nearest])
    return np.array([readings[chosen[half::2]].mean(axis=0) for half in (0, 1)])


def _clock_jacobian(R: FloatArray, v: FloatArray, p: FloatArray, at_edges: FloatArray, dt: float) -> FloatArray:
    """Derivative (9,) with respect to what is to be added to the stamps; ``at_edges`` (2, 6): readings at both ends."""
    (w0, f0), (w1, f1) = np.split(at_edges[0], 2), np.split(at_edges[1], 2)
    return np.concatenate([w0 - R @ w1, np.cross(w0, v) + f0 - R @ f1, np.cross(w0, p) + f0 * dt - v])
