# SPDX-License-Identifier: Apache-2.0
"""Height that a lift has risen: specific force along the vertical integrated twice, from rest to rest.

State: height H of the cabin above the place where it stood, m; velocity V of the rig upwards, m/s; error b of the
vertical specific force (bias of the accelerometer and error of gravity), m/s2; offset c of the barometer's height, m,
and error s of its scale. Over a time dt in which the images show the rig to rise by p within the cabin, and the
accelerometer a velocity v and a way q beyond free fall,

    H <- H + V dt + q + b dt^2 / 2 - p,    V <- V + v + b dt,

a barometer measures (1 + s)(H + sum p) + c, and the cabin at rest V = p / dt. A Rauch-Tung-Striebel smoother gives the
heights of the way once the end is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_core.geometry import FloatArray

H, V, B, C, S = range(5)
_SIGMA_START = 1e-3
"""Standard deviation (m) of the height at the start, where it is zero."""
_SIGMA_REST = 0.03
"""By how much (m/s) a cabin that has arrived may still move."""
_SPEED_NS = 400_000_000
"""The cabin's speed is its mean over at least so long."""
_UNREAD_ACCELERATION, _UNREAD_FORCE = 0.5, 0.05
"""Acceleration of a cabin over missing readings, and error of the vertical force after them, m/s2."""


@dataclass(frozen=True, eq=False)
class VerticalMotion:
    """Motion over dt (s) along the vertical.

    speed, distance: gained beyond free fall by the accelerometer, m/s and m, with covariance (2, 2) of (distance,
    speed). seen: distance (m) within the cabin, as the images show it, with its variance.
    """

    dt: float
    distance: float
    speed: float
    covariance: FloatArray
    seen: float
    seen_variance: float


@dataclass(frozen=True, eq=False)
class HeightAt:
    """Height (m) of the cabin above its start at a stamp, with its variance, m2."""

    stamp_ns: int
    height: float
    variance: float


@dataclass(frozen=True, eq=False)
class _Step:
    """One step: its transition, the state that was predicted and the state after all measurements.

    gained: height (m) gained in it, the noise of whose part seen by images has the variance ``seen_variance``, m2.
    """

    stamp_ns: int
    F: FloatArray
    predicted: FloatArray
    predicted_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    gained: float
    seen_variance: float


class RideFilter:
    """The five states, from a start at rest in the cabin.

    Parameters
    ----------
    stamp_ns
        Stamp of the start.
    speed, covariance
        Velocity upwards there, m/s, and covariance (2, 2) of it and the error of the vertical specific force.
    sigma_offset, sigma_scale
        Standard deviations of the barometer's height at the start, m, and of its scale.
    drift
        Random walk of its offset, m/sqrt(s).
    """

    def __init__(
        self,
        stamp_ns: int,
        speed: float,
        covariance: FloatArray,
        sigma_offset: float,
        sigma_scale: float,
        drift: float,
    ) -> None:
        self.start_ns = stamp_ns
        self._x = np.array([0.0, speed, 0.0, 0.0, 0.0])
        self._P = np.diag([_SIGMA_START**2, 0.0, 0.0, sigma_offset**2, sigma_scale**2])
        self._P[V : B + 1, V : B + 1] = covariance
        self._drift, self._walked = drift, 0.0
        self._steps = [_Step(stamp_ns, np.eye(5), self._x, self._P, self._x, self._P, 0.0, 0.0)]

    @property
    def stamp_ns(self) -> int:
        """Stamp that the filter has reached."""
        return self._steps[-1].stamp_ns

    @property
    def height(self) -> HeightAt:
        """Height of the cabin at the newest frame."""
        return HeightAt(self.stamp_ns, float(self._x[H]), float(self._P[H, H]))

    @property
    def velocity(self) -> float:
        """Velocity of the rig upwards at the newest frame, m/s."""
        return float(self._x[V])

    @property
    def risen(self) -> float:
        """Height of the rig above its place at the start, motion within the cabin included, m."""
        return float(self._x[H]) + self._walked

    @property
    def speed(self) -> float:
        """Mean speed of the cabin upwards over the newest frames, m/s."""
        return self._mean_speed()[0]

    def advance(self, motion: VerticalMotion, stamp_ns: int) -> None:
        """Move on by a motion to a stamp."""
        noise = np.zeros((5, 5))
        noise[:2, :2] = motion.covariance
        noise[H, H] += motion.seen_variance
        self._walked += motion.seen
        self._move(motion.dt, motion.distance - motion.seen, motion.speed, noise, motion.seen_variance, stamp_ns)

    def go_on(self, stamp_ns: int) -> None:
        """Move on to a stamp without any reading: with the speed so far, which a cabin may change."""
        dt = 1e-9 * (stamp_ns - self.stamp_ns)
        way = np.array([0.5 * dt**2, dt, 0.0, 0.0, 0.0])
        noise = _UNREAD_ACCELERATION**2 * np.outer(way, way)
        noise[B, B] = _UNREAD_FORCE**2
        self._move(dt, 0.0, 0.0, noise, float(noise[H, H]), stamp_ns)

    def _move(
        self, dt: float, way: float, speed: float, noise: FloatArray, seen_variance: float, stamp_ns: int
    ) -> None:
        F = np.eye(5)
        F[H, V], F[H, B], F[V, B] = dt, 0.5 * dt**2, dt
        x = F @ self._x
        x[H] += way
        x[V] += speed
        P = F @ self._P @ F.T + noise
        P[C, C] += self._drift**2 * dt
        gained = float(x[H] - self._x[H])
        self._x, self._P = x, 0.5 * (P + P.T)
        self._steps.append(_Step(stamp_ns, F, x, self._P, x, self._P, gained, seen_variance))

    def _mean_speed(self) -> tuple[float, float, float]:
        """Mean speed (m/s) over the newest frames, the time (s) of these, and the variance by the images."""
        gained = variance = 0.0
        for step, before in zip(self._steps[:0:-1], self._steps[-2::-1], strict=True):
            gained, variance = gained + step.gained, variance + step.seen_variance
            if self.stamp_ns - before.stamp_ns >= _SPEED_NS:
                break
        dt = 1e-9 * (self.stamp_ns - before.stamp_ns) if len(self._steps) > 1 else 0.0
        return (gained / dt, dt, variance / dt**2) if dt > 0.0 else (float(self._x[V]), 0.0, 0.0)

    def measure_pressure_height(self, height: float, variance: float) -> float:
        """Measure the rig's height above its start by a barometer; returns the squared normalised error."""
        J = np.array([1.0 + self._x[S], 0.0, 0.0, 1.0, self._x[H] + self._walked])
        predicted = (1.0 + self._x[S]) * (self._x[H] + self._walked) + self._x[C]
        return self._measure(height - predicted, J, variance)

    def come_to_rest(self) -> tuple[float, float]:
        """Measure that the cabin stands; returns the speed's error (m/s) and its squared normalised one.

        An error larger than claimed means that the specific force was worse than claimed on the whole way. The mean
        speed over a time T is V - b T / 2 less what the rig has moved within the cabin.
        """
        speed, dt, variance = self._mean_speed()
        J = np.array([0.0, 1.0, -0.5 * dt, 0.0, 0.0])
        return speed, self._measure(-speed, J, _SIGMA_REST**2 + variance)

    def smoothed(self) -> list[HeightAt]:
        """Heights at all stamps after the start, by all measurements (Rauch, Tung and Striebel 1965)."""
        x, P = self._x, self._P
        heights = [self.height]
        for step, later in zip(self._steps[-2:0:-1], self._steps[:1:-1], strict=True):
            gain = np.linalg.solve(later.predicted_covariance, later.F @ step.covariance).T
            x = step.state + gain @ (x - later.predicted)
            P = step.covariance + gain @ (P - later.predicted_covariance) @ gain.T
            heights.append(HeightAt(step.stamp_ns, float(x[H]), max(float(P[H, H]), _SIGMA_START**2)))
        return heights[::-1]

    def _measure(self, error: float, J: FloatArray, variance: float) -> float:
        cross = self._P @ J
        total = float(J @ cross) + variance
        gain = cross / total
        self._x = self._x + gain * error
        A = np.eye(5) - np.outer(gain, J)
        self._P = A @ self._P @ A.T + variance * np.outer(gain, gain)
        last = self._steps[-1]
        self._steps[-1] = replace(last, state=self._x, covariance=self._P)
        return error**2 / total
