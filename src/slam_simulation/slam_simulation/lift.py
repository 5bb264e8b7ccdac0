# SPDX-License-Identifier: Apache-2.0
"""Lift rides: the rig stands in a cabin that takes it to another storey, where all looks the same.

The cabin's sides and whatever its open door leads to are the building's rooms at their own height: pictures are drawn
from the place that a rig has within its storey (:attr:`LiftPath.within_storey`), every other sensor reads the true
motion. So storeys look alike to the last pixel, and only accelerations and air pressure tell them apart.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray
from slam_simulation.trajectory import MotionStyle, Path, SplinePath, path_cost

_SPEED_UP_SHARE = 0.25
"""Share of a ride in which the cabin gets faster, and again slower."""


@dataclass(frozen=True)
class LiftRide:
    """A ride while the agent stands at way point ``at`` (number of its path, neither end).

    ``height`` m up, or down if negative, within ``seconds``, the rig having stood for ``wait`` s before and after.
    """

    at: int
    height: float
    seconds: float = 9.0
    wait: float = 1.5

    def __post_init__(self) -> None:
        if self.at < 1 or self.seconds <= 0.0 or self.wait < 0.0:
            raise ValueError(
                f"a ride needs at >= 1, seconds > 0 and wait >= 0, got {self.at}, {self.seconds} s, {self.wait} s"
            )

    @property
    def stay(self) -> float:
        """Time from the rig's arrival at the way point to its departure, s."""
        return self.seconds + 2.0 * self.wait

    def risen(self, t: float) -> float:
        """Height (m) that the cabin has risen ``t`` s after the rig's arrival."""
        return self.height * _travelled(float(np.clip((t - self.wait) / self.seconds, 0.0, 1.0)))


class LiftPath:
    """A path through way points (n, 5), with stays in a lift at some of them.

    Parameters
    ----------
    waypoints
        As those of :class:`SplinePath`; their heights are those within a storey.
    rides
        In the order of their way points.
    duration
        Time of all, s, stays included.
    """

    def __init__(
        self,
        waypoints: FloatArray,
        rides: tuple[LiftRide, ...],
        duration: float,
        style: MotionStyle,
        rng: np.random.Generator,
    ) -> None:
        ends = [0, *(ride.at for ride in rides), len(waypoints) - 1]
        if sorted(set(ends)) != ends:
            raise ValueError(f"rides must be at inner way points in ascending order, got {ends[1:-1]} of {ends[-1]}")
        self._rides, self._duration = rides, duration
        stays = np.array([ride.stay for ride in rides])
        legs = [waypoints[first : last + 1] for first, last in itertools.pairwise(ends)]
        cost = np.array([path_cost(leg).sum() for leg in legs])
        walking = duration - float(stays.sum())
        if walking <= 0.0:
            raise ValueError(f"rides take {float(stays.sum())} s of a motion of {duration} s")
        times = walking * cost / cost.sum()
        self._legs = [SplinePath(leg, float(time), style, rng) for leg, time in zip(legs, times, strict=True)]
        self._arrivals = np.cumsum(times) + np.concatenate([[0.0], np.cumsum(stays)])

    @property
    def duration(self) -> float:
        """Time from the first to the last pose, s."""
        return self._duration

    @property
    def within_storey(self) -> Path:
        """Motion without the rides, as pictures show it."""
        return _WithinStorey(self)

    def risen(self, t: float) -> float:
        """Height (m) above the first storey at time ``t`` s."""
        return sum(ride.risen(t - arrival) for ride, arrival in zip(self._rides, self._arrivals[:-1], strict=True))

    def pose(self, t: float) -> FloatArray:
        """``T_world_rig`` at time ``t``."""
        T = self.pose_within_storey(t)
        T[2, 3] += self.risen(t)
        return T

    def pose_within_storey(self, t: float) -> FloatArray:
        """``T_world_rig`` at time ``t`` as if there had been no ride."""
        number = 0
        while number < len(self._rides) and t > self._arrivals[number] + self._rides[number].stay:
            number += 1
        begun = 0.0 if number == 0 else float(self._arrivals[number - 1]) + self._rides[number - 1].stay
        return np.array(self._legs[number].pose(t - begun))


class _WithinStorey:
    """The motion of a lift path as its pictures show it."""

    def __init__(self, path: LiftPath) -> None:
        self._path = path

    @property
    def duration(self) -> float:
        return self._path.duration

    def pose(self, t: float) -> FloatArray:
        return self._path.pose_within_storey(t)


def seen_path(path: Path) -> Path:
    """The motion as a camera in a building whose storeys look alike sees it."""
    return path.within_storey if isinstance(path, LiftPath) else path


def _travelled(s: float) -> float:
    """Share of the height after a share ``s`` of the time: speed rises and falls as a smooth step (Perlin 2002)."""
    ramp = _SPEED_UP_SHARE
    if s > 0.5:
        return 1.0 - _travelled(1.0 - s)
    x = min(s / ramp, 1.0)
    distance = ramp * x**4 * (2.5 - x * (3.0 - x)) + max(s - ramp, 0.0)
    return distance / (1.0 - ramp)
