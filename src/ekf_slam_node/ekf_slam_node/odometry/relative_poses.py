# SPDX-License-Identifier: Apache-2.0
"""Motion from elsewhere: scan registration, an external odometry, the turn rate of an IMU (thesis 9.4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.config import ExternalOdometryConfig, InertialConfig, MotionConfig, RideConfig
from ekf_slam_node.odometry.clock_watch import FARTHEST_S
from ekf_slam_node.odometry.external_odometry import ExternalOdometry, Reckoning
from ekf_slam_node.odometry.inertial import InertialFilter, Prediction, at_place
from ekf_slam_node.odometry.odometry import UpDirection
from ekf_slam_node.odometry.preintegration import ImuReadings, Preintegral
from ekf_slam_node.odometry.rides import RideWatch
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import (
    FloatArray,
    both_halves,
    boxminus,
    compose_covariance,
    interpolate_transform,
    make_transform,
    so3_log,
)
from slam_core.types import ImuSample, OdometryReading, RelativeMotion

_AID_STAMP_TOLERANCE = 0.005
"""Largest difference of the stamps of a motion aid and of the frames it joins."""
_KEPT_BEFORE_NS = round(1e9 * FARTHEST_S) + 50_000_000
"""Readings so much older than a frame may still be those of its time, or of the edge before it."""
MEAN_TURN_RATE_SIGMA = 0.02
"""Noise (rad/s) of an IMU's mean turn rate between two frames, of clocks and mounting too."""
_SIGMA_TURN_RATE = 0.1
"""By how much (rad/s) the turn rate of a moment may differ from that of a single reading."""
_ELSEWHERE = np.repeat([0.3, np.radians(5.0)], 3)
"""Places (m, rad) that look the same are at least so far apart."""
RELATIVE_POSE_GATE = chi_square_bound(0.999, 6)
"""Gate of a motion's six coordinates by two sensors, 99.9 % of true ones inside."""

ALL = slice(0, 6)
ROTATION = slice(3, 6)


@dataclass(frozen=True, eq=False)
class RelativePoseMeasurement:
    """A measured motion T = T_previous_now; ``rows`` of its error are known, with their covariance (k, k).

    source: what has measured it, for people to read. reckoned: the steps of an external odometry that it is made of.
    """

    T: FloatArray
    covariance: FloatArray
    rows: slice
    source: str = "scans"
    reckoned: Reckoning | None = None


class RelativePoseBuffer:
    """Collects what other sensors say of the motion and sums it up between two frames of the filter.

    Scans need not have the frames' stamps: a scan's motion is taken as even, and the last one goes on for at most its
    own length, with the noise of the constant-velocity model on top.
    """

    def __init__(
        self,
        config: MotionConfig,
        inertial: InertialConfig | None = None,
        external: ExternalOdometryConfig | None = None,
        ride: RideConfig | None = None,
    ) -> None:
        self._config = config
        self._motions: list[RelativeMotion] = []
        self._readings = ImuReadings()
        self.inertial = InertialFilter(config, inertial or InertialConfig())
        self.external = ExternalOdometry(external or ExternalOdometryConfig())
        self.rides = RideWatch(ride or RideConfig())
        self._newest: tuple[int, int, Preintegral | None] = (0, 0, None)
        self._reached_ns = self._doubted_ns = 0

    def add_motion(self, motion: RelativeMotion) -> bool:
        """Take a motion; False if it is not finite, not positive definite or not forward in time."""
        if not _is_usable(motion):
            return False
        if self._motions and not self._is_same_time(self._motions[-1].end_stamp_ns, motion.start_stamp_ns):
            self._motions = []
        self._motions.append(motion)
        return True

    def add_imu(self, sample: ImuSample) -> bool:
        """Take an IMU reading; False if it is not finite or not newer than the last."""
        return self._readings.add(sample)

    def add_odometry(self, reading: OdometryReading) -> str:
        """Take a reading of an external odometry; returns why it is rejected, or ""."""
        return self.external.add(reading)

    def between(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        """The best aid that covers the time between two stamps, or None."""
        return (
            self._motion_between(start_stamp_ns, end_stamp_ns)
            or self._reckoned_between(start_stamp_ns, end_stamp_ns)
            or self._rotation_between(start_stamp_ns, end_stamp_ns)
        )

    def bridge(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        """The motion without any image, by an external odometry or else by the IMU alone; None where neither knows."""
        reckoned = self._reckon(start_stamp_ns, end_stamp_ns)
        if reckoned is None:
            return self._inertial_bridge(start_stamp_ns, end_stamp_ns)
        return RelativePoseMeasurement(reckoned.T, reckoned.covariance[:6, :6], ALL, "odometry", reckoned)

    def _inertial_bridge(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        """The motion as the IMU alone tells it, from velocity and gravity at the start; None where it does not."""
        if not self.inertial.can_bridge:
            return None
        pre = self._preintegral(start_stamp_ns, end_stamp_ns)
        if pre is None:
            return None
        step = self.inertial.predict(pre)
        covariance = self.inertial.motion_covariance(step)
        T = self.rides.without_ride(self.inertial, step.T)
        return RelativePoseMeasurement(*at_place(T, covariance, -self._place()), ALL, "the IMU")

    def moved(
        self,
        start_stamp_ns: int,
        end_stamp_ns: int,
        T_previous_now: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> bool:
        """Tell the IMU's filter and the odometry of the motion that the images alone show, or that they show none.

        covariance: (6, 6) along the axes of the previous frame. False if the IMU contradicts it.
        """
        if T_previous_now is None or covariance is None:
            self.external.forget_motion()
        elif self.external.is_heard and not self.rides.is_riding:
            self.external.learn(start_stamp_ns, end_stamp_ns, T_previous_now, covariance)
        if self._readings.newest is None:
            return True
        pre = self._preintegral(start_stamp_ns, end_stamp_ns)
        if pre is None or start_stamp_ns != self._reached_ns:
            self.rides.unread(self.inertial, end_stamp_ns if pre is None else start_stamp_ns)
        self._newest, self._reached_ns = (0, 0, None), end_stamp_ns
        if pre is None:
            return True
        self.inertial.check_specific_force(pre)
        step = self.inertial.predict(pre)
        if T_previous_now is None or covariance is None:
            self.rides.unseen(self.inertial, step, end_stamp_ns)
            return True
        return self._measure_imu(step, (start_stamp_ns, end_stamp_ns), T_previous_now, covariance)

    def _measure_imu(
        self, step: Prediction, stamps: tuple[int, int], T_previous_now: FloatArray, covariance: FloatArray
    ) -> bool:
        """Let the IMU's filter measure a motion by images, in a lift as one within the cabin; False if they differ."""
        T, at_imu = at_place(T_previous_now, covariance, self._place())
        self.inertial, agrees = self.rides.measure(self.inertial, step, stamps, T, at_imu)
        return agrees

    def witness(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        """The motion, or its rotation, as an IMU tells it that has agreed with the images so far; None without one."""
        if not self.inertial.is_proven:
            return None
        bridge = None if self.rides.is_riding else self._inertial_bridge(start_stamp_ns, end_stamp_ns)
        return bridge or self._rotation_between(start_stamp_ns, end_stamp_ns)

    def is_inconsistent(
        self, start_stamp_ns: int, end_stamp_ns: int, T_previous_now: FloatArray, covariance: FloatArray
    ) -> bool:
        """True if the IMU rules out a motion that rests on looks alone, with its covariance (6, 6).

        Only by much: places that look the same are not next to each other. It counts against the IMU, too, which soon
        refutes no more if it is the one that is wrong.
        """
        told = self.witness(start_stamp_ns, end_stamp_ns)
        if told is None:
            return False
        error = np.abs(boxminus(told.T, T_previous_now))
        is_far = (error > _ELSEWHERE)[told.rows].any()
        if not is_far or not contradicts(told, T_previous_now, covariance, RELATIVE_POSE_GATE):
            return False
        self.add_inconsistency(end_stamp_ns)
        return True

    def suspects_ride(self, told: RelativePoseMeasurement, T_previous_now: FloatArray, dt: float) -> bool:
        """True if a lift may explain why the IMU tells another motion over dt (s) of a rig that is seen to stand."""
        return told.rows == ALL and self.rides.suspects(self.inertial, told.T, T_previous_now, dt)

    def add_inconsistency(self, stamp_ns: int) -> None:
        """A motion up to a stamp is not believed because of the IMU, which may be the one that is wrong."""
        if stamp_ns != self._doubted_ns:
            self._doubted_ns = stamp_ns
            self.inertial.add_inconsistency()

    @property
    def newest_stamp_ns(self) -> int:
        """Stamp of the newest IMU reading; -1 before the first."""
        return -1 if self._readings.newest is None else self._readings.newest.stamp_ns

    @property
    def up(self) -> UpDirection | None:
        """The direction against gravity at the newest linked frame, where an IMU knows it."""
        return UpDirection(self.inertial.up, self.inertial.tilt_covariance) if self.inertial.can_bridge else None

    def velocity(self) -> tuple[FloatArray, FloatArray]:
        """Velocities (6,) of the rig as the odometry has them, or else the IMU, with standard deviations (6,)."""
        if (known := self.external.velocity()) is not None:
            return known
        newest = self._readings.newest
        rate = np.zeros(3) if newest is None else newest.angular_velocity - self.inertial.biases[:3]
        velocity = np.concatenate([self.inertial.velocity - np.cross(rate, self._place()), rate])
        return velocity, np.concatenate([self.inertial.sigma_velocity, np.full(3, _SIGMA_TURN_RATE)])

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what lies before the frame the filter has reached; the last of it stays, it may go on."""
        older = sum(motion.end_stamp_ns <= stamp_ns for motion in self._motions)
        del self._motions[: max(older - 1, 0)]
        self._readings.forget_before(stamp_ns - _KEPT_BEFORE_NS)
        learning_ns = self.external.window_start_ns
        self.external.readings.forget_before(stamp_ns if learning_ns is None else learning_ns)

    # ---- an external odometry
    def _reckon(self, start_stamp_ns: int, end_stamp_ns: int) -> Reckoning | None:
        if not self.external.is_heard:
            return None
        return self.external.reckon(start_stamp_ns, end_stamp_ns, self._turns, self.inertial.gyro_bias_covariance)

    def _reckoned_between(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        reckoned = self._reckon(start_stamp_ns, end_stamp_ns)
        if reckoned is None:
            return None
        return RelativePoseMeasurement(reckoned.T, self.external.between(reckoned), ALL, "odometry", reckoned)

    def _turns(self, start_stamp_ns: int, end_stamp_ns: int) -> Preintegral | None:
        if not self.inertial.is_proven:
            return None
        return self._integrated(start_stamp_ns, end_stamp_ns)

    # ---- scans
    def _motion_between(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        if not self._motions or not self._motions_cover(start_stamp_ns, end_stamp_ns):
            return None
        T, covariance = np.eye(4), np.zeros((6, 6))
        for number, motion in enumerate(self._motions):
            last = number == len(self._motions) - 1
            begin = max(start_stamp_ns, motion.start_stamp_ns)
            end = end_stamp_ns if last else min(end_stamp_ns, motion.end_stamp_ns)
            if end > begin:
                share = (end - begin) / (motion.end_stamp_ns - motion.start_stamp_ns)
                beyond = max(end - motion.end_stamp_ns, 0) * 1e-9
                part = self._part(motion, share, beyond)
                T, covariance = T @ part.T, compose_covariance(T, covariance, part.T, part.covariance)
        return RelativePoseMeasurement(T, covariance, ALL)

    def _motions_cover(self, start_stamp_ns: int, end_stamp_ns: int) -> bool:
        first, last = self._motions[0], self._motions[-1]
        tolerance = _AID_STAMP_TOLERANCE * 1e9
        reach = last.end_stamp_ns + max(tolerance, last.end_stamp_ns - last.start_stamp_ns)
        return first.start_stamp_ns <= start_stamp_ns + tolerance and end_stamp_ns <= reach

    def _part(self, motion: RelativeMotion, share: float, beyond: float) -> RelativeMotion:
        T = interpolate_transform(np.eye(4), motion.T, np.array(share))
        length = (motion.end_stamp_ns - motion.start_stamp_ns) * 1e-9
        sigma = np.repeat([self._config.sigma_acceleration, self._config.sigma_angular_acceleration], 3)
        noise = np.diag(np.square(sigma * beyond * (beyond + length)))
        return replace(motion, T=T, covariance=motion.covariance * max(share, 1.0) ** 2 + noise)

    # ---- turn rates
    def _rotation_between(self, start_stamp_ns: int, end_stamp_ns: int) -> RelativePoseMeasurement | None:
        pre = self._preintegral(start_stamp_ns, end_stamp_ns)
        if pre is None or not self.inertial.uses_turns:
            return None
        variance = np.eye(3) * MEAN_TURN_RATE_SIGMA**2 + self.inertial.gyro_bias_covariance
        return RelativePoseMeasurement(make_transform(pre.R, np.zeros(3)), variance * pre.dt**2, ROTATION, "the IMU")

    def _place(self) -> FloatArray:
        return np.zeros(3) if self._readings.newest is None else self._readings.newest.position

    def _preintegral(self, start_stamp_ns: int, end_stamp_ns: int) -> Preintegral | None:
        """Preintegral with the present biases; the newest one is kept until they change."""
        if self._newest[:2] != (start_stamp_ns, end_stamp_ns):
            self._newest = start_stamp_ns, end_stamp_ns, self._integrated(start_stamp_ns, end_stamp_ns)
        return self._newest[2]

    def _integrated(self, start_stamp_ns: int, end_stamp_ns: int) -> Preintegral | None:
        start_ns, end_ns = start_stamp_ns - self.time_offset_ns, end_stamp_ns - self.time_offset_ns
        return self._readings.integrate(start_ns, end_ns, self.inertial.biases, self.inertial.noise)

    @property
    def time_offset_ns(self) -> int:
        """Time to be added to the IMU's stamps, as it was learnt, ns."""
        return round(1e9 * self.inertial.time_offset)

    def _is_same_time(self, a: int, b: int) -> bool:
        return abs(a - b) <= _AID_STAMP_TOLERANCE * 1e9


def relative_pose_error(
    aid: RelativePoseMeasurement, T_previous_now: FloatArray, rotation_map_previous: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Error (k,) of a motion as an aid sees it, along the map's axes, and its covariance (k, k)."""
    error = np.concatenate([aid.T[:3, 3] - T_previous_now[:3, 3], so3_log(aid.T[:3, :3] @ T_previous_now[:3, :3].T)])
    turn = both_halves(rotation_map_previous)
    rows = turn[aid.rows, aid.rows]
    return (turn @ error)[aid.rows], rows @ aid.covariance @ rows.T


def contradicts(aid: RelativePoseMeasurement, T_previous_now: FloatArray, covariance: FloatArray, gate: float) -> bool:
    """True if an aid lies beyond the gate of a motion found otherwise, with its covariance (6, 6).

    Scan registration that has slid along a wall is as wrong as it is sure of itself, and only vision can tell.
    """
    error = boxminus(aid.T, T_previous_now)[aid.rows]
    S = aid.covariance + covariance[aid.rows, aid.rows]
    return not float(error @ np.linalg.solve(S, error)) < gate


def _is_usable(motion: RelativeMotion) -> bool:
    finite = np.isfinite(motion.T).all() and np.isfinite(motion.covariance).all()
    return bool(
        finite and motion.end_stamp_ns > motion.start_stamp_ns and np.linalg.eigvalsh(motion.covariance)[0] > 0.0
    )
