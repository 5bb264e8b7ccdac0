# SPDX-License-Identifier: Apache-2.0
"""Evidence of a lift: over about a second the accelerometer tells a way upwards or downwards, the images none.

The way apart follows from the state at the first motion in view by the preintegrals in between; its covariance is that
of that state (velocity, gravity, biases, clock), of the readings and of the images' motions, as much larger as the
filter has seen its predictions to be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.odometry.inertial import InertialFilter
from ekf_slam_node.odometry.preintegration import Preintegral
from slam_core.geometry import FloatArray, both_halves, so3_exp

WINDOW_NS, _SHORTEST_NS = 1_200_000_000, 350_000_000
"""Motions are compared over at most, and at least, so long."""
STANDING_SPEED = 0.35
"""A rig that stands, or turns round, in a cabin is seen to move no faster, m/s."""
_SIGMAS, _LEAST = 5.0, 0.08
"""A way apart is believed beyond so many standard deviations, and this, m."""
SIDEWAYS = 0.5
"""Share of the vertical difference that may be seen along the other axes."""
_STEADY_S, _KNOWN_S = 3e-3, 4e-3
"""A clock that is being learnt (change, standard deviation) makes a way apart of its own."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Motion T (4, 4) of the IMU's place that the images show, with its covariance (6, 6), and the filter before it.

    pre: readings of that time, with the biases (rad/s, m/s2) and the clock (s) of ``before``.
    """

    start_ns: int
    end_ns: int
    pre: Preintegral
    T: FloatArray
    covariance: FloatArray
    before: InertialFilter

    def for_filter(self, inertial: InertialFilter) -> Preintegral:
        """The readings with the biases and the clock of another filter, to first order."""
        biases = inertial.biases - self.before.biases
        change = np.append(biases, inertial.time_offset - self.before.time_offset)
        pre = self.pre
        turn, v, p = np.split(pre.J @ change, 3)
        return replace(pre, R=so3_exp(turn) @ pre.R, v=pre.v + v, p=pre.p + p)


def is_carried(seen: Sequence[Seen]) -> bool:
    """True if the accelerometer tells of a way along the vertical that motions (one after the other) do not show."""
    first, before = seen[0], seen[0].before
    if seen[-1].end_ns - first.start_ns < _SHORTEST_NS or len(seen) < 2 or not before.can_bridge:
        return False
    if any(np.linalg.norm(s.T[:3, 3]) > STANDING_SPEED * s.pre.dt for s in seen) or not _has_steady_clock(seen):
        return False
    up, apart = before.up, _apart(seen)
    rise = float(up @ apart)
    aside = float(np.linalg.norm(apart - rise * up))
    if abs(rise) <= _LEAST or aside >= SIDEWAYS * abs(rise):
        return False
    variance = max(before.variance_scale, 1.0) * float(up @ _apart_covariance(seen) @ up)
    return abs(rise) > _SIGMAS * float(np.sqrt(variance))


def _has_steady_clock(seen: Sequence[Seen]) -> bool:
    offsets = [s.before.time_offset for s in seen]
    return max(offsets) - min(offsets) < _STEADY_S and max(s.before.sigma_time_offset for s in seen) < _KNOWN_S


def _apart(seen: Sequence[Seen]) -> FloatArray:
    """Way (3,) of the accelerometer less that of the images, along the first axes, m."""
    before = seen[0].before
    velocity, R, apart = before.velocity, np.eye(3), np.zeros(3)
    for one in seen:
        pre = one.for_filter(before)
        apart = apart + velocity * pre.dt + 0.5 * pre.dt**2 * before.gravity + R @ (pre.p - one.T[:3, 3])
        velocity = velocity + before.gravity * pre.dt + R @ pre.v
        R = R @ one.T[:3, :3]
    return apart


def _apart_covariance(seen: Sequence[Seen]) -> FloatArray:
    """Covariance (3, 3) of that way, m2."""
    J_velocity, J_gravity, J_apart = np.eye(3, 13), np.eye(3, 13, 3), np.zeros((3, 13))
    noise, rows, R = np.zeros((6, 6)), np.array([6, 7, 8, 3, 4, 5]), np.eye(3)
    for one in seen:
        pre, dt = one.pre, one.pre.dt
        J_apart = J_apart + dt * J_velocity + 0.5 * dt**2 * J_gravity
        J_velocity = J_velocity + dt * J_gravity
        J_apart[:, 6:] += R @ pre.J[6:]
        J_velocity[:, 6:] += R @ pre.J[3:6]
        F, turn = np.eye(6), both_halves(R)
        F[:3, 3:] = dt * np.eye(3)
        noise = F @ noise @ F.T + turn @ pre.covariance[np.ix_(rows, rows)] @ turn.T
        noise[:3, :3] += R @ one.covariance[:3, :3] @ R.T
        R = R @ one.T[:3, :3]
    return np.asarray(J_apart @ seen[0].before.covariance @ J_apart.T + noise[:3, :3])
