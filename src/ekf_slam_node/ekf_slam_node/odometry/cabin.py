# SPDX-License-Identifier: Apache-2.0
"""A rig in the cabin of a lift: an inertial filter that learns nothing of the vertical, and the cabin's height."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ekf_slam_node.config import RideConfig
from ekf_slam_node.odometry.carried import Seen
from ekf_slam_node.odometry.preintegration import Preintegral
from ekf_slam_node.odometry.pressure import PressureHeights
from ekf_slam_node.odometry.ride_filter import HeightAt, RideFilter, VerticalMotion
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, make_transform

_REST_NS = 560_000_000
"""A cabin that has not changed its speed for so long, and is slow, has arrived."""
_SLOW_SHARE, _SLOW = 0.3, 0.12
"""It is slow below this share of the fastest speed of the ride, or this speed, m/s."""
_CONSTANT = 0.1
"""Changes of the speed (m/s) over that time which are none."""
_LEFT_CABIN = 2.5
"""A rig that is seen this far (m) from where the ride began has left the cabin."""
_CONTRADICTED = chi_square_bound(0.99, 1)
"""Squared normalised error of the speed at the end beyond which heights are as much less certain."""
_IMPOSSIBLE = 25.0
"""And beyond which there was no ride, or its start was missed."""
_LONGEST_NS, _FASTEST, _VAGUEST = 90_000_000_000, 6.0, 3.0
"""No ride takes longer, is faster (m/s) or as uncertain (standard deviation of its height, m)."""
_SPEEDING_S, _SPEEDING = 4, 0.08
"""No cabin gains so much speed (m/s) in each of so many seconds."""
_OPEN = 10.0
"""Standard deviation (m) of the vertical motion for the inertial filter during a ride."""
_UNSEEN_SPEED = 0.3
"""Speed (m/s) within the cabin where no image shows the rig."""
_REFUSED = 25.0
"""Squared normalised error beyond which a barometer contradicts the accelerometer."""
_SIGMAS = 3.0
"""A barometer tells a change of height beyond so many standard deviations, and agrees within them."""
_LEAST_CHANGE = 0.25
"""And beyond this one, m: doors and gusts change the pressure."""


@dataclass(frozen=True, eq=False)
class Ride:
    """A ride that is over: height (m) with its variance, and heights at the frames in between."""

    start_ns: int
    end_ns: int
    height: float
    variance: float
    heights: tuple[HeightAt, ...]

    @property
    def text(self) -> str:
        """Height and its standard deviation in words."""
        return f"{self.height:+.2f} +- {np.sqrt(self.variance):.2f} m"


class Cabin:
    """A ride from its first motion on.

    ``inertial``: the filter of a rig that rides. ``heights``: height of the cabin above its start at each frame.
    ``pressure_refused``: readings of the barometer that contradict the accelerometer.
    """

    def __init__(self, config: RideConfig, first: Seen, pressure: PressureHeights) -> None:
        self.inertial = first.before.fork()
        self._pressure, self._config = pressure, config
        up = self.inertial.up
        J = np.zeros((2, 13))
        J[0, :3], J[1, 3:6], J[1, 9:12] = up, up, -up
        covariance = max(self.inertial.variance_scale, 1.0) * J @ self.inertial.covariance @ J.T
        self._sigma_reference = pressure.start(first.start_ns)
        self._filter = RideFilter(
            first.start_ns, float(up @ self.inertial.velocity), covariance, self._sigma_reference,
            config.sigma_pressure_scale, config.pressure_drift,
        )  # fmt: skip
        self._place, self._turn = np.zeros(3), np.eye(3)
        self._gravity: float | None = None
        self._fastest, self._speeds = 0.0, deque[tuple[int, float]]()
        self._risen: list[tuple[int, float]] = [(first.start_ns, 0.0)]
        self.heights: list[HeightAt] = []
        self.pressure_refused = 0

    @property
    def start_ns(self) -> int:
        """Stamp of the start."""
        return self._filter.start_ns

    @property
    def stamp_ns(self) -> int:
        """Stamp of the newest frame."""
        return self._filter.stamp_ns

    @property
    def height(self) -> HeightAt:
        """Height of the cabin above its start at the newest frame."""
        return self._filter.height

    # ---------------------------------------------------------------------------------------------------- each frame
    def take(self, seen: Seen, with_pressure: bool) -> None:
        """Take a motion within the cabin, and measure the air's pressure at its end if that is wanted."""
        inertial, T = self.inertial, seen.T
        step = inertial.predict(seen.for_filter(inertial))
        up = inertial.up
        self._filter.advance(_vertical(up, step.pre, self._known_gravity(), T, seen.covariance), seen.end_ns)
        if with_pressure:
            self._measure_pressure(seen.end_ns)
        carried = T.copy()
        carried[:3, 3] += up * float(up @ (step.T[:3, 3] - T[:3, 3]))
        wide = seen.covariance.copy()
        wide[:3, :3] += _OPEN**2 * np.outer(up, up)
        inertial.measure(step, carried, wide)
        self._place = self._place + self._turn @ T[:3, 3]
        self._turn = self._turn @ T[:3, :3]
        self._note()

    def unseen(self, pre: Preintegral, stamp_ns: int) -> None:
        """Go on to a frame that no image links."""
        step = self.inertial.predict(pre)
        sigma = np.repeat([_UNSEEN_SPEED * step.dt, 1.0], 3)
        T = make_transform(step.T[:3, :3], np.zeros(3))
        covariance = np.diag(sigma**2)
        self._filter.advance(_vertical(self.inertial.up, pre, self._known_gravity(), T, covariance), stamp_ns)
        self.inertial.advance(step)
        self._note()

    def unread(self, stamp_ns: int) -> None:
        """Go on to a stamp over readings that are missing: the cabin keeps its speed, more or less."""
        if stamp_ns > self._filter.stamp_ns:
            self._filter.go_on(stamp_ns)
            self._note()
        gravity = self.inertial.gravity
        if self._gravity is None:
            self._gravity = float(np.linalg.norm(gravity))
        self.inertial.forget_motion(gravity)

    def _known_gravity(self) -> FloatArray:
        """Gravity (3,) at the newest frame: with its size before readings were missing, as a cabin's force differs."""
        return self.inertial.gravity if self._gravity is None else -self._gravity * self.inertial.up

    def _measure_pressure(self, stamp_ns: int) -> None:
        told = self._pressure.since(self._filter.start_ns, stamp_ns)
        if told is not None and self._filter.measure_pressure_height(*told) > _REFUSED:
            self.pressure_refused += 1

    def _note(self) -> None:
        stamp_ns, speed = self._filter.stamp_ns, self._filter.speed
        self.heights.append(self._filter.height)
        self._risen.append((stamp_ns, self._filter.risen))
        self._fastest = max(self._fastest, abs(speed))
        self._speeds.append((stamp_ns, speed))
        while self._speeds[0][0] < stamp_ns - (_SPEEDING_S + 1) * 10**9:
            self._speeds.popleft()

    # ------------------------------------------------------------------------------------------------------- verdicts
    @property
    def is_confirmed(self) -> bool:
        """True if the barometer tells a significant change of height that agrees with the accelerometer's."""
        readings = self._pressure.recent(self.start_ns, self.stamp_ns)
        if not len(readings):
            return False
        stamps, risen = np.array(self._risen).T
        expected = float(np.interp(readings[:, 0], stamps, risen).mean())
        told = float(readings[:, 1].mean())
        drift = self._config.pressure_drift**2 * 1e-9 * (self.stamp_ns - self.start_ns)
        told_variance = self._sigma_reference**2 + float(readings[0, 2]) + drift
        variance = self.height.variance + (self._config.sigma_pressure_scale * expected) ** 2
        return (
            abs(told) > max(_SIGMAS * np.sqrt(told_variance), _LEAST_CHANGE)
            and expected * told > 0.0
            and abs(expected) > _SIGMAS * np.sqrt(variance)
            and abs(told - expected) < _SIGMAS * np.sqrt(told_variance + variance)
        )

    @property
    def is_impossible(self) -> bool:
        """True if no lift moves like this, or nothing is known of its height any more."""
        is_long = self.stamp_ns - self.start_ns > _LONGEST_NS
        is_vague = self.height.variance > _VAGUEST**2
        return is_long or is_vague or abs(self._filter.velocity) > _FASTEST or self._is_speeding()

    def _is_speeding(self) -> bool:
        """True if the cabin has become faster, or slower, in each of the last seconds: a force that is wrong."""
        stamps, speeds = np.array(self._speeds).T
        times = self.stamp_ns - 1e9 * np.arange(_SPEEDING_S, -1, -1)
        if stamps[0] > times[0]:
            return False
        gained = np.diff(np.interp(times, stamps, speeds))
        return bool((gained > _SPEEDING).all() or (gained < -_SPEEDING).all())

    @property
    def has_ended(self) -> bool:
        """True if the cabin has arrived, or the rig has left it."""
        return self.is_at_rest or float(np.linalg.norm(self._place)) > _LEFT_CABIN

    @property
    def is_at_rest(self) -> bool:
        """True if the cabin has neither been fast nor changed its speed for a while."""
        stamps, speeds = np.array(self._speeds).T
        first = int(np.searchsorted(stamps, self.stamp_ns - _REST_NS, side="right")) - 1
        if first < 0 or len(stamps) - first < 2:
            return False
        speeds = speeds[first:]
        is_slow = bool(np.abs(speeds).max() < max(_SLOW_SHARE * self._fastest, _SLOW))
        return is_slow and bool(np.ptp(speeds) < _CONSTANT)

    @property
    def is_slow(self) -> bool:
        """True if the cabin hardly moves any more."""
        return abs(self._filter.speed) < _SLOW < self._fastest

    def concluded(self) -> Ride | None:
        """The ride, its cabin now at rest; None if the accelerometer's speed contradicts that by too much."""
        error, squared = self._filter.come_to_rest()
        if squared > _IMPOSSIBLE:
            return None
        widened, apart = (squared, error) if squared > _CONTRADICTED else (1.0, 0.0)
        smoothed = self._filter.smoothed()
        way = tuple(
            HeightAt(
                at.stamp_ns, at.height, at.variance * widened + (apart * 1e-9 * (at.stamp_ns - self.start_ns)) ** 2
            )
            for at in smoothed
        )
        return Ride(self.start_ns, self.stamp_ns, way[-1].height, way[-1].variance, way)


def _vertical(
    up: FloatArray, pre: Preintegral, gravity: FloatArray, T: FloatArray, covariance: FloatArray
) -> VerticalMotion:
    """Vertical part of a motion; ``up`` and gravity (3,) along the axes of its start."""
    rows = np.array([6, 7, 8, 3, 4, 5])
    turn = np.zeros((2, 6))
    turn[0, :3], turn[1, 3:] = up, up
    noise = turn @ pre.covariance[np.ix_(rows, rows)] @ turn.T
    way = float(up @ (pre.p + 0.5 * gravity * pre.dt**2))
    speed = float(up @ (pre.v + gravity * pre.dt))
    return VerticalMotion(pre.dt, way, speed, noise, float(up @ T[:3, 3]), float(up @ covariance[:3, :3] @ up))
