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

from slam_core.geometry import FloatArray, skew, so3_exp
from slam_core.types import LONGEST_IMU_STEP_S, ImuSample

_EDGE_S = np.linspace(0.0025, 0.0175, 4)
"""Rates at an edge are means before and after it: a single reading's noise would be taken for a change of the rates."""
_HELD_NS = 1_500_000
"""The first and the last reading hold for twice as long beyond them."""
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


@dataclass(frozen=True, eq=False)
class Preintegral:
    """Turn R (3, 3), change of velocity v (3,) m/s, way p (3,) m over dt (s).

    J: (9, 7) derivative of the errors of (turn, v, p) with respect to the biases (gyroscope, accelerometer) and to
    what is to be added to the stamps, s.
    clock_turns: (2, 3) derivative of the turn with respect to these, by readings before and after the edges alone.
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
        inside = (stamps > start_ns) & (stamps < end_ns)
        edges = np.concatenate([[start_ns], stamps[inside], [end_ns]])
        middle = 0.5 * (edges[1:] + edges[:-1]) - start_ns
        turn_rates = np.array([sample.angular_velocity for sample in self._samples])
        forces = np.array([sample.linear_acceleration for sample in self._samples])
        times = (stamps - start_ns).astype(np.float64)
        columns = (*turn_rates.T, *forces.T)
        at_middle = np.column_stack([np.interp(middle, times, column) for column in columns])
        around = np.array([0.0, end_ns - start_ns])[:, None] + 1e9 * np.array([-_EDGE_S, _EDGE_S])[:, None]
        at_edges = np.stack([np.interp(around, times, column).mean(axis=2) for column in columns], axis=2)
        silent = np.clip(np.diff(edges) * 1e-9 - LONGEST_IMU_STEP_S, 0.0, None) > 0.0
        silent |= np.maximum(times[0] - middle, middle - times[-1]) > _HELD_NS
        return _integrated(at_middle, at_edges, biases, np.diff(edges) * 1e-9, silent, noise)


def _integrated(
    readings: FloatArray, at_edges: FloatArray, biases: FloatArray, dt: FloatArray, silent: np.ndarray, noise: ImuNoise
) -> Preintegral:
    """Preintegral of readings (n, 6), each held for dt (n,) s; ``at_edges`` (2, 2, 6) before and after both ends."""
    size = float(np.linalg.norm(readings[:, 3:], axis=1).mean())
    readings = readings - biases
    rates = readings[:, :3]
    turns, half = np.split(so3_exp(np.concatenate([rates * dt[:, None], 0.5 * rates * dt[:, None]])), 2)
    R, before = np.eye(3), np.empty_like(turns)
    for k, turn in enumerate(turns):
        before[k] = R
        R = R @ turn
    middle = before @ half
    force = np.einsum("nij,nj->ni", middle, readings[:, 3:])
    step, until = dt[:, None], dt.sum() - np.cumsum(dt)
    v = np.cumsum(force * step, axis=0)
    p = np.cumsum((v - force * step) * step + 0.5 * force * step**2, axis=0)
    clock = [
        _clock_jacobian(R, v[-1], p[-1], part - biases, float(dt.sum())) for part in (*at_edges, at_edges.mean(axis=0))
    ]
    return Preintegral(
        float(dt.sum()),
        R,
        v[-1],
        p[-1],
        np.column_stack([_bias_jacobian(middle, force, dt), clock[2]]),
        np.array(clock)[:2, :3],
        _noise_covariance(v, p, dt, until, silent, noise),
        v[-1] / dt.sum(),
        size,
    )


def _bias_jacobian(middle: FloatArray, force: FloatArray, dt: FloatArray) -> FloatArray:
    """Derivative (9, 6), with turns taken as small within one interval."""
    width = dt[:, None, None]
    turn = -np.cumsum(middle * width, axis=0)
    # What the turn has gone wrong by at the middle of each interval turns the force of it.
    at_middle = turn + 0.5 * middle * width
    rates = np.concatenate([-skew(force) @ at_middle, -middle], axis=2)
    v = np.cumsum(rates * width, axis=0)
    p = np.sum((v - rates * width) * width + 0.5 * rates * width**2, axis=0)
    J = np.zeros((9, 6))
    J[:3, :3], J[3:6], J[6:] = turn[-1], v[-1], p
    return J


def _clock_jacobian(R: FloatArray, v: FloatArray, p: FloatArray, at_edges: FloatArray, dt: float) -> FloatArray:
    """Derivative (9,) with respect to what is to be added to the stamps."""
    (w0, f0), (w1, f1) = np.split(at_edges[0], 2), np.split(at_edges[1], 2)
    return np.concatenate([w0 - R @ w1, np.cross(w0, v) + f0 - R @ f1, np.cross(w0, p) + f0 * dt - v])


def _noise_covariance(
    v: FloatArray, p: FloatArray, dt: FloatArray, until: FloatArray, silent: np.ndarray, noise: ImuNoise
) -> FloatArray:
    """Covariance (9, 9): each interval's noise is fresh and acts on all that follows it."""
    gyro = np.where(silent, (noise.unknown_turn * dt) ** 2, noise.gyro**2 * dt)
    force = np.where(silent, (noise.unknown_force * dt) ** 2, noise.accelerometer**2 * dt)
    n = len(dt)
    of_turn, of_force = np.zeros((n, 9, 3)), np.zeros((n, 9, 3))
    of_turn[:, :3] = np.eye(3)
    of_turn[:, 3:6] = -skew(v[-1] - v)
    of_turn[:, 6:] = -skew(p[-1] - p - v * until[:, None])
    of_force[:, 3:6] = np.eye(3)
    of_force[:, 6:] = np.eye(3) * (until + 0.5 * dt)[:, None, None]
    C = np.einsum("nij,n,nkj->ik", of_turn, gyro, of_turn) + np.einsum("nij,n,nkj->ik", of_force, force, of_force)
    return np.asarray(0.5 * (C + C.T))
