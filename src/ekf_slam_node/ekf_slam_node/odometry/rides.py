# SPDX-License-Identifier: Apache-2.0
"""Lift rides: found where the images show no motion and the accelerometer one along the vertical, from rest to rest.

Over the last second the way that the accelerometer tells, from the velocity that the images had shown before, is
compared with that of the images. Where the rig is seen to stand, and the two differ upwards or downwards by more than
their errors allow, but not sideways, a cabin carries rig and view along. The inertial filter goes back to the start of
that second and counts the images' motion from there on as one within the cabin, which tells nothing of the vertical
(:class:`~ekf_slam_node.odometry.ride_filter.RideFilter` does), until the cabin has come to rest.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass

import numpy as np

from ekf_slam_node.config import RideConfig
from ekf_slam_node.odometry.inertial import InertialFilter, Prediction
from ekf_slam_node.odometry.preintegration import Preintegral
from ekf_slam_node.odometry.pressure import PressureHeights
from ekf_slam_node.odometry.ride_filter import HeightAt, RideFilter, VerticalMotion
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, make_transform

_WINDOW_NS, _SHORTEST_NS = 1_200_000_000, 350_000_000
"""Motions are compared over at most, and at least, so long."""
_STANDING_SPEED = 0.35
"""A rig that stands, or turns round, in a cabin is seen to move no faster, m/s."""
_SIGMAS, _LEAST = 5.0, 0.08
"""A ride is believed beyond so many standard deviations, and this way, m."""
_SIDEWAYS = 0.5
"""Share of the vertical difference that may be seen along the other axes."""
_REST_NS = 800_000_000
"""A cabin that has not changed its speed for so long, and is slow, has arrived."""
_SLOW_SHARE, _SLOW = 0.3, 0.12
"""It is slow below this share of the fastest speed of the ride, or this speed, m/s."""
_CONSTANT = 0.1
"""Changes of the speed (m/s) over that time which are none."""
_LEFT_CABIN = 2.5
"""A rig that is seen this far (m) from where the ride began has left the cabin."""
_CONTRADICTED = chi_square_bound(0.99, 1)
"""Squared normalised error of the speed at the end beyond which heights are as much less certain."""
_LONGEST_NS = 300_000_000_000
_OPEN = 10.0
"""Standard deviation (m) of the vertical motion for the inertial filter during a ride."""
_UNSEEN_SPEED = 0.3
"""Speed (m/s) within the cabin where no image shows the rig."""


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


@dataclass(frozen=True, eq=False)
class _Seen:
    """Motion T (4, 4) of the IMU's place that the images show, with its covariance, and the filter before it."""

    start_ns: int
    end_ns: int
    pre: Preintegral
    T: FloatArray
    covariance: FloatArray
    before: InertialFilter


class RideWatch:
    """Finds rides of one rig and follows them.

    ``begun``: heights so far at the frames of a ride found by the newest frame. ``ended``: the ride that it ended.
    """

    def __init__(self, config: RideConfig) -> None:
        self._config = config
        self._seen: deque[_Seen] = deque()
        self._filter: RideFilter | None = None
        self._fastest, self._speeds = 0.0, deque[tuple[int, float]]()
        self._place = np.zeros(3)
        self._turn = np.eye(3)
        self.pressure = PressureHeights(config)
        self.begun: tuple[HeightAt, ...] = ()
        self.ended: Ride | None = None
        self.pressure_refused = 0

    @property
    def is_riding(self) -> bool:
        """True from the frame that finds a ride to the one that ends it."""
        return self._filter is not None

    @property
    def height(self) -> HeightAt | None:
        """Height of the cabin above the start of the ride, during one."""
        return None if self._filter is None else self._filter.height

    def suspects(self, inertial: InertialFilter, told: FloatArray, T: FloatArray, dt: float) -> bool:
        """True if the IMU contradicts a rig that is seen to stand, and mainly along the vertical.

        told: motion (4, 4) by the IMU, T: by the images, over dt (s).
        """
        if self._config.use == "off" or not inertial.can_bridge:
            return False
        error = told[:3, 3] - T[:3, 3]
        rise = float(inertial.up @ error)
        aside = float(np.linalg.norm(error - rise * inertial.up))
        return float(np.linalg.norm(T[:3, 3])) < _STANDING_SPEED * dt and aside < _SIDEWAYS * abs(rise)

    def forget_events(self) -> None:
        """A new frame comes, which may begin or end another ride."""
        self.begun, self.ended = (), None

    def forget(self) -> None:
        """Motions are missing: what was compared before has no end."""
        self._seen.clear()

    # ---------------------------------------------------------------------------------------------------- each frame
    def take(
        self, inertial: InertialFilter, step: Prediction, stamps: tuple[int, int], T: FloatArray, covariance: FloatArray
    ) -> InertialFilter:
        """Take the motion of a frame before the inertial filter measures it; returns the filter to go on with.

        That is the given one, unless a ride is found: then it is the one of the ride's start, taken through its frames.
        """
        if self._config.use == "off" or self._filter is not None:
            return inertial
        if self._seen and self._seen[-1].end_ns != stamps[0]:
            self._seen.clear()
        self._seen.append(_Seen(*stamps, step.pre, T, covariance, copy.copy(inertial)))
        while self._seen and self._seen[0].start_ns < stamps[1] - _WINDOW_NS:
            self._seen.popleft()
        return self._begin() if self._seen and self._is_carried() else inertial

    def within_cabin(
        self, inertial: InertialFilter, step: Prediction, stamp_ns: int, T: FloatArray, covariance: FloatArray
    ) -> None:
        """Take a frame's motion within the cabin during a ride, and let the inertial filter measure what it tells."""
        assert self._filter is not None
        self._filter.advance(_vertical(inertial.up, step.pre, inertial.gravity, T, covariance), stamp_ns)
        told = self.pressure.since(self._filter.start_ns, stamp_ns)
        if told is not None and self._filter.measure_pressure_height(*told) > _SIGMAS**2:
            self.pressure_refused += 1
        up = inertial.up
        carried = T.copy()
        carried[:3, 3] += up * float(up @ (step.T[:3, 3] - T[:3, 3]))
        wide = covariance.copy()
        wide[:3, :3] += _OPEN**2 * np.outer(up, up)
        inertial.measure(step, carried, wide)
        self._place = self._place + self._turn @ T[:3, 3]
        self._turn = self._turn @ T[:3, :3]
        self._note_speed(stamp_ns)

    def unseen(self, inertial: InertialFilter, step: Prediction, stamp_ns: int) -> None:
        """Go on to a frame that no image links; outside a ride what was compared before has no end."""
        if self._filter is None:
            self.forget()
            return
        sigma = np.repeat([_UNSEEN_SPEED * step.dt, 1.0], 3)
        T = make_transform(step.T[:3, :3], np.zeros(3))
        self._filter.advance(_vertical(inertial.up, step.pre, inertial.gravity, T, np.diag(sigma**2)), stamp_ns)
        self._note_speed(stamp_ns)

    def without_ride(self, inertial: InertialFilter, T: FloatArray) -> FloatArray:
        """Motion T (4, 4) that the IMU tells, as one within the cabin during a ride: without its rise."""
        if self._filter is None:
            return T
        within = T.copy()
        within[:3, 3] -= inertial.up * float(inertial.up @ T[:3, 3])
        return within

    def end_if_at_rest(self, stamp_ns: int) -> None:
        """End the ride if the cabin has arrived, or the rig has left it."""
        if self._filter is None or not (self._is_at_rest() or self._has_left(stamp_ns)):
            return
        squared = self._filter.come_to_rest()
        widened = squared if squared > _CONTRADICTED else 1.0
        now = self._filter.height
        way = tuple(HeightAt(at.stamp_ns, at.height, at.variance * widened) for at in self._filter.smoothed())
        self.ended = Ride(self._filter.start_ns, stamp_ns, now.height, now.variance * widened, way)
        self._filter = None
        self._seen.clear()

    # --------------------------------------------------------------------------------------------------------- inside
    def _is_carried(self) -> bool:
        """True if the accelerometer tells of a way along the vertical that the images do not show."""
        first = self._seen[0]
        dt = 1e-9 * (self._seen[-1].end_ns - first.start_ns)
        before = first.before
        if 1e9 * dt < _SHORTEST_NS or len(self._seen) < 2 or not before.can_bridge:
            return False
        if any(np.linalg.norm(s.T[:3, 3]) > _STANDING_SPEED * s.pre.dt for s in self._seen):
            return False
        velocity, R, apart = before.velocity.copy(), np.eye(3), np.zeros(3)
        seen_covariance = np.zeros((3, 3))
        for seen in self._seen:
            pre = seen.pre
            way = R.T @ velocity * pre.dt + R.T @ before.gravity * (0.5 * pre.dt**2) + pre.p
            apart = apart + R @ (way - seen.T[:3, 3])
            velocity = velocity + before.gravity * pre.dt + R @ pre.v
            seen_covariance = seen_covariance + R @ seen.covariance[:3, :3] @ R.T
            R = R @ seen.T[:3, :3]
        up = before.up
        rise = float(up @ apart)
        aside = float(np.linalg.norm(apart - rise * up))
        J = np.concatenate([dt * up, 0.5 * dt**2 * up, np.zeros(3), -0.5 * dt**2 * up, [0.0]])
        noise = self._accelerometer_variance(before) * dt**3 / 3.0
        variance = float(J @ before.covariance @ J) + float(up @ seen_covariance @ up) + noise
        return abs(rise) > max(_SIGMAS * np.sqrt(variance), _LEAST) and aside < _SIDEWAYS * abs(rise)

    @staticmethod
    def _accelerometer_variance(inertial: InertialFilter) -> float:
        return float(inertial.noise.accelerometer**2)

    def _begin(self) -> InertialFilter:
        """Start a ride at the oldest motion in view, and go through the others again as motions within the cabin."""
        first = self._seen[0]
        inertial = copy.copy(first.before)
        up = inertial.up
        J = np.zeros((2, 13))
        J[0, :3], J[1, 3:6], J[1, 9:12] = up, up, -up
        covariance = J @ inertial.covariance @ J.T
        sigma_offset, sigma_scale = self.pressure.start(first.start_ns), self._config.sigma_pressure_scale
        self._filter = RideFilter(
            first.start_ns, float(up @ inertial.velocity), covariance, sigma_offset, sigma_scale,
            self._config.pressure_drift,
        )  # fmt: skip
        self._fastest, self._place, self._turn = 0.0, np.zeros(3), np.eye(3)
        self._speeds.clear()
        heights = []
        for seen in list(self._seen)[:-1]:
            self.within_cabin(inertial, inertial.predict(seen.pre), seen.end_ns, seen.T, seen.covariance)
            heights.append(self._filter.height)
        self.begun = tuple(heights) or (self._filter.height,)
        self._seen.clear()
        return inertial

    def _note_speed(self, stamp_ns: int) -> None:
        assert self._filter is not None
        speed = self._filter.speed
        self._fastest = max(self._fastest, abs(speed))
        self._speeds.append((stamp_ns, speed))
        while self._speeds[0][0] < stamp_ns - _REST_NS:
            self._speeds.popleft()

    def _is_at_rest(self) -> bool:
        """True if the cabin has neither been fast nor changed its speed for a while."""
        speeds = np.array([speed for _, speed in self._speeds])
        if len(speeds) < 2 or self._speeds[-1][0] - self._speeds[0][0] < 0.7 * _REST_NS:
            return False
        is_slow = bool(np.abs(speeds).max() < max(_SLOW_SHARE * self._fastest, _SLOW))
        return is_slow and bool(np.ptp(speeds) < _CONSTANT)

    def _has_left(self, stamp_ns: int) -> bool:
        assert self._filter is not None
        is_far = float(np.linalg.norm(self._place)) > _LEFT_CABIN
        return is_far or stamp_ns - self._filter.start_ns > _LONGEST_NS


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
