# SPDX-License-Identifier: Apache-2.0
"""ScanPoints odometry.

Each scan is registered to a local map of the last keyframes, starting from constant velocity, and fused with that
prediction.

A failed registration is never integrated: the pose moves on by the prediction alone, its covariance grows, no relative
motion is handed out, and when the scans keep failing the map starts anew where the prediction has brought us.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from ndt_registration.gyro import Gyro, GyroConfig
from ndt_registration.keyframe_window import KeyframeWindow, ScanPoints
from ndt_registration.methods.pyramid import GridConfig
from ndt_registration.methods.uncertainty import UncertaintyConfig
from ndt_registration.motion_filter import MotionFilter, MotionFilterConfig, rotated
from ndt_registration.registration import (
    DegenerateCloudError,
    RegistrationConfig,
    RegistrationResult,
    check_cloud,
    failure,
    for_dimension,
    register_cloud,
)
from slam_core.config import Config, group
from slam_core.geometry import FloatArray, boxminus, compose_jacobians, invert_transform
from slam_core.types import RelativeMotion

_KEYFRAME_OVERLAP = 0.75
"""Overlap over the best since the last keyframe, below which a scan becomes one."""
_KEYFRAME_ANGLE_DEG = 12.0
"""Rotation likewise, deg."""
_MAX_CORRECTION = 0.5
"""Largest deviation from the guess."""
_MAX_CORRECTION_DEG = 20.0
"""Largest turn away from the guess, deg."""
_MAX_GAP = 1.0
"""Gap between scans above which the velocity is not used."""
_SEARCH_AFTER = 1
"""Failures after which the pose is searched globally, if no other source knows the motion."""

ODOMETRY_REGISTRATION = RegistrationConfig(
    source_points=4000,
    target_points=8000,
    start_level=1,
    rim_share=0.2,
    grid=GridConfig(flatness=0.0, levels=3),
    uncertainty=UncertaintyConfig(least_loss=0.06, loss_noise=0.05),
)
"""From a near guess. Cells keep their own normals: what is rough in them holds a scan of a wall where it started, while
on perfect planes it would slide. That is little knowledge of the pose: a determined one must lose more, and how far one
that is not may be off follows from what it loses.
"""
_KEYFRAMES = 10
"""Keyframes in the local map."""
_KEYFRAME_DISTANCE = 0.3
"""Distance (m) from the last keyframe above which a scan becomes one."""


@dataclass(frozen=True)
class OdometryConfig(Config):
    """ScanPoints odometry."""

    restart_after: int = 5
    """Failures after which the map starts anew."""
    motion: MotionFilterConfig = group(MotionFilterConfig)
    imu: GyroConfig = group(GyroConfig)
    registration: RegistrationConfig = field(default_factory=lambda: ODOMETRY_REGISTRATION)


class OdometryStatus(Enum):
    """State of the odometry after a scan."""

    STARTED = "STARTED"
    TRACKING = "TRACKING"
    FAILED = "FAILED"
    RESTARTED = "RESTARTED"


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """Pose T_odom_sensor with covariance (6, 6).

    Motion since the previous scan, None if either of the two failed; status.
    """

    stamp_ns: int
    T: FloatArray
    covariance: FloatArray
    motion: RelativeMotion | None
    status: OdometryStatus
    reason: str
    registration: RegistrationResult | None = None


class ScanOdometry:
    """Poses of consecutive scans of one sensor, in space or, for scans (n, 2), in the plane."""

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self._config = config or OdometryConfig()
        self._map = KeyframeWindow(_KEYFRAMES)
        self._filter = MotionFilter(self._config.motion)
        self._gyro = Gyro(self._config.imu)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the origin."""
        self._map.clear()
        self._filter.start(np.eye(4))
        self._gyro.clear()
        self._stamp_ns = self._last_stamp_ns = 0
        self._failures = 0
        self._best_overlap = 0.0

    def process(self, stamp_ns: int, points: npt.ArrayLike, prior: RelativeMotion | None = None) -> OdometryResult:
        """Register a scan, shape (..., 3) or (..., 2) m in the sensor's frame, NaN where invalid.

        ``prior`` is the motion of the sensor since the previous scan from another source, such as wheels; without it
        constant velocity is assumed, with the turn of an IMU where there is one.
        """
        scan = ScanPoints.of(points)
        if self._map.target is None:
            return self._start(stamp_ns, scan, self._filter.covariance)
        if stamp_ns <= self._stamp_ns:
            raise ValueError(f"scans must be in order of time, got stamp {stamp_ns} ns after {self._stamp_ns} ns")
        self._predict(stamp_ns, prior)
        result = self._register(scan, lost=prior is None and self._failures >= _SEARCH_AFTER)
        return self._track(scan, result) if result.converged else self._fail(scan, result)

    def add_angular_velocity(self, stamp_ns: int, rate: FloatArray) -> None:
        """Take an IMU's angular velocity (3,) rad/s, along the axes of the scanning sensor, ahead of later scans."""
        self._gyro.add(stamp_ns, rate)

    def _start(self, stamp_ns: int, scan: ScanPoints, covariance: FloatArray) -> OdometryResult:
        """Begin a map with a scan that is where the filter is, known so well."""
        self._stamp_ns, T = stamp_ns, self._filter.T
        try:
            self._add_keyframe(covariance, scan)
        except ValueError as error:
            return OdometryResult(stamp_ns, T, covariance, None, OdometryStatus.FAILED, str(error))
        return OdometryResult(stamp_ns, T, covariance, None, OdometryStatus.STARTED, "")

    def _predict(self, stamp_ns: int, prior: RelativeMotion | None) -> None:
        self._last_stamp_ns, self._stamp_ns = self._stamp_ns, stamp_ns
        seconds = 1e-9 * (stamp_ns - self._last_stamp_ns)
        if prior is not None:
            self._filter.move(prior.T, prior.covariance, seconds)
            return
        if seconds > _MAX_GAP:
            self._filter.forget_velocity()
        self._filter.predict(seconds)
        turn = self._gyro.turn(self._last_stamp_ns, stamp_ns)
        if turn is not None:
            self._filter.turn(turn, self._gyro.sigma(seconds))

    def _registration(self, scan: ScanPoints) -> RegistrationConfig:
        return for_dimension(self._config.registration, planar=scan.planar)

    def _register(self, scan: ScanPoints, *, lost: bool) -> RegistrationResult:
        """The scan's pose in the newest keyframe."""
        guess = invert_transform(self._map.newest.T) @ self._filter.T
        result = self._plausible(self._registered(scan, guess))
        if not result.converged and lost:
            self._filter.lose()
            return self._registered(scan, None)
        return result

    def _registered(self, scan: ScanPoints, guess: FloatArray | None) -> RegistrationResult:
        """The scan registered to the map, from a guess or searched."""
        target, config = self._map.target, self._registration(scan)
        assert target is not None
        try:
            check_cloud(scan.points, "source", config)
        except DegenerateCloudError as error:
            return failure(str(error))
        return register_cloud(scan.cloud(config.source_points), target, guess, config)

    def _plausible(self, result: RegistrationResult) -> RegistrationResult:
        """The result, as a failure where it would move the pose too far; where it may slide it does not count."""
        correction = self._filter.correction(*self._in_odometry(result))
        distance, angle = np.linalg.norm(correction[:3]), np.rad2deg(np.linalg.norm(correction[3:]))
        if result.converged and (distance > _MAX_CORRECTION or angle > _MAX_CORRECTION_DEG):
            reason = f"implausible: {distance:.2f} m and {angle:.1f} deg from the guess"
            return replace(result, converged=False, reason=reason)
        return result

    def _in_odometry(self, result: RegistrationResult) -> tuple[FloatArray, FloatArray]:
        """Pose and covariance of a registration in the odometry's frame."""
        T_odom_key = self._map.newest.T
        return T_odom_key @ result.T_target_source, rotated(T_odom_key, result.covariance)

    def _track(self, scan: ScanPoints, result: RegistrationResult) -> OdometryResult:
        self._filter.fuse(*self._in_odometry(result))
        covariance = self._covariance()
        motion = None if self._failures else self._motion()
        self._failures = 0
        self._best_overlap = max(self._best_overlap, result.overlap)
        if self._is_keyframe(result):
            self._add_keyframe(covariance, scan)
        return OdometryResult(
            self._stamp_ns, self._filter.T, covariance, motion, OdometryStatus.TRACKING, result.reason, result
        )

    def _motion(self) -> RelativeMotion:
        return RelativeMotion(self._last_stamp_ns, self._stamp_ns, *self._filter.motion())

    def _covariance(self) -> FloatArray:
        """Covariance of the pose: that of the newest keyframe's and that of the pose in the local map."""
        keyframe = self._map.newest
        T_key_now = invert_transform(keyframe.T) @ self._filter.T
        J = compose_jacobians(keyframe.T, T_key_now)[0]
        return np.asarray(J @ keyframe.covariance @ J.T + self._filter.covariance)

    def _add_keyframe(self, covariance: FloatArray, scan: ScanPoints) -> None:
        self._map.add(self._filter.T, covariance, scan, self._registration(scan))
        self._best_overlap = 0.0

    def _is_keyframe(self, result: RegistrationResult) -> bool:
        moved = boxminus(result.T_target_source, np.eye(4))
        return bool(
            result.overlap < _KEYFRAME_OVERLAP * self._best_overlap
            or np.linalg.norm(moved[:3]) > _KEYFRAME_DISTANCE
            or np.rad2deg(np.linalg.norm(moved[3:])) > _KEYFRAME_ANGLE_DEG
        )

    def _fail(self, scan: ScanPoints, result: RegistrationResult) -> OdometryResult:
        self._failures += 1
        if self._failures >= self._config.restart_after and len(scan.points) >= self._registration(scan).min_points:
            return self._restart(scan, result)
        T, covariance = self._filter.T, self._covariance()
        return OdometryResult(self._stamp_ns, T, covariance, None, OdometryStatus.FAILED, result.reason, result)

    def _restart(self, scan: ScanPoints, result: RegistrationResult) -> OdometryResult:
        covariance = self._covariance()
        self._map.clear()
        self._filter.start(self._filter.T)
        self._failures = 0
        started = self._start(self._stamp_ns, scan, covariance)
        status = OdometryStatus.RESTARTED if started.status is OdometryStatus.STARTED else OdometryStatus.FAILED
        return replace(started, status=status, reason=f"map started anew: {result.reason}", registration=result)
