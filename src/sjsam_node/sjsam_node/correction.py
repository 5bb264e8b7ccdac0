# SPDX-License-Identifier: Apache-2.0
"""``map_to_odom`` as it is published: the estimate, or on request one that moves towards it at a bounded speed.

A closed loop moves the estimate at once, which a controller takes for a jump of the robot. With a bound the published
transform follows on the geodesic of SE(3) from where it is, ``T exp(s log(T^-1 T_wanted))``. Along it a point p of the
odometry frame moves at the constant speed ``|v + omega x p|``, so that the share s is known in closed form.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from sjsam_node.node_config import SjsamNodeConfig
from sjsam_node.pose_tracker import PoseTracker
from slam_core.geometry import (
    FloatArray,
    boxminus,
    invert_transform,
    make_transform,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
    transform_points,
)
from slam_core.types import PoseEstimate

_LONGEST_SILENCE_S = 1.0
"""``map_to_odom`` is stamped as if time went on for so long after the last odometry."""
_CLOCK_SET_BACK_NS = 2_000_000_000
"""Stamps that go back by more are those of a clock that was set; less is the odometry's delay."""


class CorrectionLimit:
    """Transform that follows another at a bounded speed.

    Parameters
    ----------
    max_speed
        Largest speed of the odometry's origin, and of the rig for the correction alone, in the map, m/s; 0: any.
    max_rate
        Largest angular speed, rad/s; 0: any.

    ``stamp_ns`` is the newest stamp that it was asked for, to which its transform belongs.
    """

    def __init__(self, max_speed: float, max_rate: float) -> None:
        self._bounds = (max_speed, max_speed, max_rate)
        self._T: FloatArray | None = None
        self.stamp_ns = 0

    def forget(self) -> None:
        """Take the next transform as it is: the one before is no place to come from."""
        self._T = None

    def follow(self, stamp_ns: int, wanted: FloatArray, rig: FloatArray) -> FloatArray:
        """The transform (4, 4) at a stamp, on the way to ``wanted``; ``rig`` (3,) m is the rig's place in the odometry.

        Between two stamps it moves by at most the bounds times their difference; not at all where that is negative.
        """
        if self._T is None:
            self._T, self.stamp_ns = wanted, stamp_ns
            return wanted
        elapsed_s = max(1e-9 * (stamp_ns - self.stamp_ns), 0.0)
        if stamp_ns > self.stamp_ns or self.stamp_ns - stamp_ns > _CLOCK_SET_BACK_NS:
            self.stamp_ns = stamp_ns
        way = _se3_log(invert_transform(self._T) @ wanted)
        share = self._share(way, rig, elapsed_s)
        self._T = wanted if share >= 1.0 else self._T @ _se3_exp(share * way)
        return self._T

    def _share(self, way: FloatArray, rig: FloatArray, elapsed_s: float) -> float:
        """Share of a way, in the tangent (6,) of the transform, that may be gone in so long."""
        v, omega = way[:3], way[3:]
        lengths = [float(np.linalg.norm(part)) for part in (v, v + np.cross(omega, rig), omega)]
        bounded = [(bound, n) for bound, n in zip(self._bounds, lengths, strict=True) if n > 0.0 and bound > 0.0]
        return min((bound * elapsed_s / length for bound, length in bounded), default=1.0)


class MapToOdom:
    """``map_to_odom`` of one agent: when, where and how surely it is published."""

    def __init__(self, config: SjsamNodeConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit = CorrectionLimit(config.max_correction_speed, config.max_correction_rate)
        self._clock = clock
        self._heard_at_s: float | None = None
        self.is_bounded = config.max_correction_speed > 0.0 or config.max_correction_rate > 0.0
        self.tracker = PoseTracker(None)

    def heard(self) -> None:
        """Note that the agent's odometry, or where there is none a submap of it, has come."""
        self._heard_at_s = self._clock()

    def start(self, tracker: PoseTracker) -> None:
        """Begin anew: the map is another one."""
        self.tracker = tracker
        self._limit.forget()

    def lose(self) -> None:
        """Say nothing until the agent is located again; from there it begins anew."""
        self.tracker.lose()
        self._limit.forget()

    def at_present(self, last_stamp_ns: int, tolerance_s: float) -> tuple[PoseEstimate, float] | None:
        """The transform to publish, and how far in m it is behind the estimate; None where the place is not known.

        Parameters
        ----------
        last_stamp_ns
            Time that is known where no odometry is heard.
        tolerance_s
            How far ahead of the present it is stamped.
        """
        wanted = self.tracker.map_to_odom()
        if wanted is None or self._heard_at_s is None:
            return None
        rig, newest_ns = self.tracker.newest_in_odom().T[:3, 3], self.tracker.newest_ns or last_stamp_ns
        gone_s = min(self._clock() - self._heard_at_s, _LONGEST_SILENCE_S)
        stamp_ns = newest_ns + round(1e9 * (gone_s + tolerance_s))
        T = self._limit.follow(stamp_ns, wanted.T, rig)
        if self.is_bounded:  # by an older stamp it would have moved faster
            stamp_ns = self._limit.stamp_ns
        behind = boxminus(wanted.T, T)
        held_back_m = float(np.linalg.norm(transform_points(wanted.T, rig[None]) - transform_points(T, rig[None])))
        return PoseEstimate(stamp_ns, T, wanted.covariance + np.outer(behind, behind)), held_back_m


def _se3_log(T: FloatArray) -> FloatArray:
    """Tangent (6,), translation first, of a transform (4, 4)."""
    omega = so3_log(T[:3, :3])
    return np.concatenate([so3_left_jacobian_inverse(omega) @ T[:3, 3], omega])


def _se3_exp(way: FloatArray) -> FloatArray:
    """Inverse of :func:`_se3_log`."""
    return make_transform(so3_exp(way[3:]), so3_left_jacobian(way[3:]) @ way[:3])
