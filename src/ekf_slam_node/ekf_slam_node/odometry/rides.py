# SPDX-License-Identifier: Apache-2.0
"""Lift rides: found where the images show no motion and the accelerometer one along the vertical, from rest to rest.

Over the last second the way that the accelerometer tells, from the velocity that the images had shown before, is
compared with that of the images (:mod:`~ekf_slam_node.odometry.carried`). Where the rig is seen to stand, and the two
differ upwards or downwards, but not sideways, a cabin may carry rig and view along. From the start of that second a
second inertial filter then counts the images' motion as one within the cabin, which tells nothing of the vertical
(:class:`~ekf_slam_node.odometry.cabin.Cabin`). It takes the place of the first one once a barometer tells the same
change of height, until the cabin has come to rest. The first one goes on beside it, and is back where no lift can have
moved like that.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ekf_slam_node.config import RideConfig
from ekf_slam_node.odometry.cabin import Cabin, Ride
from ekf_slam_node.odometry.carried import SIDEWAYS, STANDING_SPEED, WINDOW_NS, Seen, is_carried
from ekf_slam_node.odometry.inertial import InertialFilter, Prediction
from ekf_slam_node.odometry.pressure import PressureHeights
from ekf_slam_node.odometry.ride_filter import HeightAt
from slam_core.geometry import FloatArray

_PENDING_NS = 5_000_000_000
"""A barometer has to confirm a ride within so long of its start."""


class RideWatch:
    """Finds rides of one rig and follows them.

    ``begun``: heights so far at the frames of a ride found by the newest frame. ``ended``: the ride that it ended.
    ``is_retracted``: whether it showed that a ride was none.
    """

    def __init__(self, config: RideConfig) -> None:
        self._config = config
        self._seen: deque[Seen] = deque()
        self._cabin: Cabin | None = None
        self._pending: Cabin | None = None
        self._standing: InertialFilter | None = None
        self.pressure = PressureHeights(config)
        self.begun: tuple[HeightAt, ...] = ()
        self.ended: Ride | None = None
        self.is_retracted = False
        self.pressure_refused = 0

    @property
    def is_looking(self) -> bool:
        """True if rides are looked for."""
        use = self._config.use
        return use == "imu" or (use == "auto" and self.pressure.is_heard)

    @property
    def is_riding(self) -> bool:
        """True from the frame that finds a ride to the one that ends it."""
        return self._cabin is not None

    @property
    def is_pending(self) -> bool:
        """True while the accelerometer tells of a ride that no barometer has confirmed yet."""
        return self._pending is not None

    @property
    def height(self) -> HeightAt | None:
        """Height of the cabin above the start of the ride, during one."""
        return None if self._cabin is None else self._cabin.height

    def suspects(self, inertial: InertialFilter, told: FloatArray, T: FloatArray, dt: float) -> bool:
        """True if the IMU contradicts a rig that is seen to stand, and mainly along the vertical.

        told: motion (4, 4) by the IMU, T: by the images, over dt (s).
        """
        if not self.is_looking or not inertial.can_bridge:
            return False
        error = told[:3, 3] - T[:3, 3]
        rise = float(inertial.up @ error)
        aside = float(np.linalg.norm(error - rise * inertial.up))
        return float(np.linalg.norm(T[:3, 3])) < STANDING_SPEED * dt and aside < SIDEWAYS * abs(rise)

    def forget_events(self) -> None:
        """A new frame comes, which may begin or end another ride."""
        self.begun, self.ended, self.is_retracted = (), None, False

    # ---------------------------------------------------------------------------------------------------- each frame
    def measure(
        self, inertial: InertialFilter, step: Prediction, stamps: tuple[int, int], T: FloatArray, covariance: FloatArray
    ) -> tuple[InertialFilter, bool]:
        """Let the filter measure a motion by images, in a lift as one within the cabin.

        Returns the filter to go on with, and False if the IMU contradicts the motion.
        """
        if not self.is_looking:
            return inertial, inertial.measure(step, T, covariance)
        seen = Seen(*stamps, step.pre, T, covariance, inertial.fork())
        if self._cabin is not None:
            assert self._standing is not None
            self._standing.measure(self._standing.predict(seen.for_filter(self._standing)), T, covariance)
            self._cabin.take(seen, with_pressure=True)
            return self._after_ride(self._cabin), True
        agrees = inertial.measure(step, T, covariance)
        if not self._looks_like_a_ride(seen):
            return inertial, agrees
        cabin = self._pending
        assert cabin is not None
        self._cabin, self._pending, self._standing = cabin, None, inertial
        self.begun = tuple(cabin.heights[:-1])
        self._seen.clear()
        return cabin.inertial, True

    def unseen(self, inertial: InertialFilter, step: Prediction, stamp_ns: int) -> None:
        """Go on to a frame that no image links; outside a ride what was compared before has no end."""
        if self._cabin is None:
            self._forget_motions()
            inertial.advance(step)
            return
        assert self._standing is not None
        start_ns = self._cabin.stamp_ns
        seen = Seen(start_ns, stamp_ns, step.pre, step.T, step.covariance[:6, :6], inertial.fork())
        self._standing.advance(self._standing.predict(seen.for_filter(self._standing)))
        self._cabin.unseen(step.pre, stamp_ns)

    def unread(self, inertial: InertialFilter, stamp_ns: int) -> None:
        """Go on to a stamp over readings that are missing."""
        self._forget_motions()
        if self._cabin is None:
            inertial.forget_motion()
            return
        assert self._standing is not None
        self._standing.forget_motion()
        self._cabin.unread(stamp_ns)

    def without_ride(self, inertial: InertialFilter, T: FloatArray) -> FloatArray:
        """Motion T (4, 4) that the IMU tells, as one within the cabin during a ride: without its rise."""
        if self._cabin is None:
            return T
        within = T.copy()
        within[:3, 3] -= inertial.up * float(inertial.up @ T[:3, 3])
        return within

    def conclude(self) -> Ride | None:
        """End a ride because mapping ends: None if there is none, or its cabin had not stopped yet."""
        cabin, self._cabin, self._standing = self._cabin, None, None
        self._forget_motions()
        if cabin is None or not cabin.is_slow:
            return None
        self.pressure_refused += cabin.pressure_refused
        return cabin.concluded()

    # --------------------------------------------------------------------------------------------------------- inside
    def _looks_like_a_ride(self, seen: Seen) -> bool:
        """True once accelerometer and, where it is asked, barometer tell a ride: ``_pending`` is the cabin then."""
        if self._seen and self._seen[-1].end_ns != seen.start_ns:
            self._forget_motions()
        self._seen.append(seen)
        while self._seen[0].start_ns < seen.end_ns - WINDOW_NS and len(self._seen) > 1:
            self._seen.popleft()
        if self._pending is not None:
            self._pending.take(seen, with_pressure=False)
        elif is_carried(self._seen):
            self._pending = Cabin(self._config, self._seen[0], self.pressure)
            for one in self._seen:
                self._pending.take(one, with_pressure=False)
        if self._pending is None or self._config.use == "imu" or self._pending.is_confirmed:
            return self._pending is not None
        if self._pending.stamp_ns - self._pending.start_ns > _PENDING_NS or self._pending.is_impossible:
            self._forget_motions()
        return False

    def _after_ride(self, cabin: Cabin) -> InertialFilter:
        """The filter to go on with: in the cabin, at the new storey, or the one of a rig that has stood still."""
        if not (cabin.is_impossible or cabin.has_ended):
            return cabin.inertial
        standing = self._standing
        assert standing is not None
        self.ended = cabin.concluded() if cabin.has_ended else None
        self.is_retracted = self.ended is None
        self.pressure_refused += cabin.pressure_refused
        self._cabin, self._standing = None, None
        self._forget_motions()
        return standing if self.is_retracted else cabin.inertial

    def _forget_motions(self) -> None:
        self._seen.clear()
        self._pending = None
