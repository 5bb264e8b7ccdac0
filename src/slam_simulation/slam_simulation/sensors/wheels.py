# SPDX-License-Identifier: Apache-2.0
"""Wheel odometry: the motion over the floor below the rig, with slip and wheels of another radius than is believed.

Along the path each reading takes the step since the one before, of (dx, dy) m and a turn, and reports

    (dx, dy) (1 + radius_error) (1 + slip a),   turn (1 + slip b) + slip c |(dx, dy)| / track

turned by the mounting's yaw error. a, b, c are noise of variance one that lasts for half a second (first-order
Gauss-Markov), as floors and tyres have it: no fresh noise in each reading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from slam_core.config import Config, parameter
from slam_core.geometry import (
    FloatArray,
    compose_covariance,
    euler_from_rotation,
    make_transform,
    rotation_from_euler,
)
from slam_core.types import OdometryReading
from slam_simulation.trajectory import Path

SLIP_LASTS_S = 0.5
TRACK_M = 0.5
FRAME = "base_footprint"
_PLANAR = np.array([0, 1, 5])
_UNKNOWN_VARIANCE = 1e6
"""Of what wheels do not measure: height, roll and pitch."""


@dataclass(frozen=True)
class WheelSensorConfig(Config):
    """Wheels of a rig that drives."""

    rate: float = parameter(50.0, "readings per second", unit="Hz", minimum=1.0)
    slip: float = parameter(0.01, "spread of the share of a step that slips", minimum=0.0, maximum=1.0)
    radius_error: float = parameter(0.0, "wheels are believed larger by this share", minimum=-0.5, maximum=0.5)
    yaw_error_deg: float = parameter(0.0, "error of their mounting's yaw", unit="deg", minimum=-45.0, maximum=45.0)
    claims_covariance: bool = parameter(True, "covariances are reported; false: zeros, as many drivers do")


class WheelSensor:
    """Reads the motion of one path; the readings do not depend on how often they are asked for.

    Parameters
    ----------
    height
        Of the rig's frame over the floor, m.
    """

    def __init__(self, config: WheelSensorConfig, path: Path, height: float, seed: tuple[int, ...]) -> None:
        self.config = config
        self.T_rig_frame = make_transform(np.eye(3), np.array([0.0, 0.0, -height]))
        self._stamps = np.arange(int(np.floor(path.duration * config.rate + 1e-9)) + 1) / config.rate
        self._integrate(np.stack([path.pose(t) for t in self._stamps]) @ self.T_rig_frame, np.random.default_rng(seed))

    def read(self, first_s: float, last_s: float, start_ns: int) -> tuple[OdometryReading, ...]:
        """Readings after ``first`` up to ``last``; ``start_ns``: stamp of time zero."""
        inside = np.flatnonzero((self._stamps > first_s + 1e-9) & (self._stamps <= last_s + 1e-9))
        return tuple(self._reading(int(k), start_ns) for k in inside)

    def _integrate(self, T: FloatArray, rng: np.random.Generator) -> None:
        """Poses and covariances of all readings, from true poses T (n, 4, 4)."""
        c, n = self.config, len(T)
        heading = np.unwrap(euler_from_rotation(T[:, :3, :3])[:, 0])
        steps, turns = np.diff(T[:, :2, 3], axis=0), np.diff(heading)
        keeps = np.exp(-1.0 / (c.rate * SLIP_LASTS_S))
        fresh = rng.standard_normal((3, n))
        fresh[:, 1:] *= np.sqrt(1.0 - keeps**2)
        slip = c.slip * lfilter([1.0], [1.0, -keeps], fresh, axis=1)[:, 1:]
        # Noise that lasts grows as fresh noise of this many times the variance would.
        lasting = (1.0 + keeps) / (1.0 - keeps)
        self._T = np.tile(np.eye(4), (n, 1, 1))
        self._covariance = np.zeros((n, 6, 6))
        self._twist = np.zeros((n, 6))
        for k in range(n - 1):
            own = rotation_from_euler(-heading[k] - np.radians(c.yaw_error_deg))
            way = own[:2, :2] @ steps[k] * (1.0 + c.radius_error) * (1.0 + slip[0, k])
            length = float(np.linalg.norm(steps[k]))
            turn = turns[k] * (1.0 + slip[1, k]) + slip[2, k] * length / TRACK_M
            step = make_transform(rotation_from_euler(turn), np.array([*way, 0.0]))
            sigma = c.slip * np.array([length, length, np.hypot(turns[k], length / TRACK_M)])
            noise = np.zeros((6, 6))
            noise[_PLANAR, _PLANAR] = lasting * sigma**2
            self._T[k + 1] = self._T[k] @ step
            self._covariance[k + 1] = compose_covariance(self._T[k], self._covariance[k], step, noise)
            self._twist[k + 1] = np.array([*way, 0.0, 0.0, 0.0, turn]) * c.rate

    def _reading(self, k: int, start_ns: int) -> OdometryReading:
        covariance, twist_covariance = np.zeros((2, 6, 6))
        if self.config.claims_covariance:
            covariance, unknown = self._covariance[k].copy(), np.setdiff1d(np.arange(6), _PLANAR)
            covariance[unknown, unknown] = _UNKNOWN_VARIANCE
            twist_covariance = np.diag((self.config.slip * np.abs(self._twist[k])) ** 2 + 1e-8)
            twist_covariance[unknown, unknown] = _UNKNOWN_VARIANCE
        stamp_ns = start_ns + round(float(self._stamps[k]) * 1e9)
        return OdometryReading(
            stamp_ns, self._T[k], covariance, self._twist[k], twist_covariance, FRAME, self.T_rig_frame
        )
