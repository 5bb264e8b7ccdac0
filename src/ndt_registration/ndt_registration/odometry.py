"""Scan odometry: each scan is registered to a local map of the last keyframes, starting from constant velocity.

A failed registration is never integrated: the pose moves on by the guess alone, its covariance grows, no relative
motion is handed out, and when the scans keep failing the map starts anew where the guess has brought us.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from ndt_registration.cloud import finite_points
from ndt_registration.local_map import LocalMap
from ndt_registration.registration import RegistrationConfig, RegistrationResult, register
from slam_core.config import Config, parameter
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    compose_covariance,
    inverse_jacobian,
    invert_transform,
    pose7_from_transform,
    transform_from_pose7,
)
from slam_core.types import RelativeMotion


@dataclass(frozen=True)
class OdometryConfig(Config):
    """Scan odometry."""

    keyframes: int = parameter(10, "keyframes in the local map", minimum=1)
    keyframe_overlap: float = parameter(0.75, "overlap below which a scan becomes a keyframe", minimum=0.0, maximum=1.0)
    keyframe_distance: float = parameter(
        0.3, "distance from the last keyframe above which a scan becomes one", unit="m", minimum=0.0
    )
    keyframe_angle_deg: float = parameter(12.0, "rotation likewise", unit="deg", minimum=0.0)
    max_correction: float = parameter(0.5, "largest deviation from the guess", unit="m", minimum=0.0)
    max_correction_deg: float = parameter(20.0, "likewise", unit="deg", minimum=0.0)
    max_gap: float = parameter(1.0, "gap between scans above which the velocity is not used", unit="s", minimum=0.0)
    search_after: int = parameter(1, "failures after which the pose is searched globally", minimum=0)
    restart_after: int = parameter(5, "failures after which the map starts anew", minimum=1)
    acceleration_sigma: float = parameter(1.0, "acceleration while registrations fail", unit="m/s2", minimum=0.0)
    angular_acceleration_sigma: float = parameter(2.0, "likewise", unit="rad/s2", minimum=0.0)
    registration: RegistrationConfig = field(
        default_factory=lambda: RegistrationConfig(source_points=4000, target_points=8000, start_level=1)
    )


class OdometryStatus(Enum):
    """State of the odometry after a scan."""

    STARTED = "STARTED"
    TRACKING = "TRACKING"
    FAILED = "FAILED"
    RESTARTED = "RESTARTED"


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """Pose T_odom_sensor with covariance (6, 6); motion since the previous scan, None if either of the two failed;
    status.
    """

    stamp_ns: int
    T: FloatArray
    covariance: FloatArray
    motion: RelativeMotion | None
    status: OdometryStatus
    reason: str
    registration: RegistrationResult | None = None


class ScanOdometry:
    """Poses of consecutive scans of one sensor."""

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self._config = config or OdometryConfig()
        self._map = LocalMap(self._config.keyframes, self._config.registration)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next scan is the origin."""
        self._map.clear()
        self._stamp_ns = 0
        self._T = np.eye(4)
        self._covariance = 1e-12 * np.eye(6)
        self._step = np.zeros(6)
        self._step_seconds = 0.0
        self._local = (np.eye(4), 1e-12 * np.eye(6))
        self._failures = 0
        self._tracked = False

    def process(self, stamp_ns: int, points: npt.ArrayLike, prior: RelativeMotion | None = None) -> OdometryResult:
        """Register a scan, shape (..., 3) m in the sensor's frame, NaN where invalid.

        ``prior`` is the motion of the sensor since the previous scan from another source, such as an IMU; without it
        constant velocity is assumed.
        """
        scan = finite_points(points)
        if self._map.target is None:
            return self._start(stamp_ns, scan)
        if stamp_ns <= self._stamp_ns:
            raise ValueError(f"scans must be in order of time, got stamp {stamp_ns} ns after {self._stamp_ns} ns")
        guess = self._T @ (self._predicted_motion(stamp_ns) if prior is None else prior.T)
        result = self._register(scan, guess)
        if not result.converged:
            return self._fail(stamp_ns, scan, guess, result)
        return self._track(stamp_ns, scan, result)

    def _start(self, stamp_ns: int, scan: FloatArray) -> OdometryResult:
        status = OdometryStatus.STARTED
        reason = ""
        try:
            self._map.add(self._T, self._covariance, scan)
            self._local = (np.eye(4), 1e-12 * np.eye(6))
            self._tracked = True
        except ValueError as error:
            status, reason = OdometryStatus.FAILED, str(error)
        self._stamp_ns = stamp_ns
        return OdometryResult(stamp_ns, self._T, self._covariance, None, status, reason)

    def _predicted_motion(self, stamp_ns: int) -> FloatArray:
        """Motion since the last scan at the velocity of the one before, in the sensor's frame."""
        seconds = 1e-9 * (stamp_ns - self._stamp_ns)
        if self._step_seconds <= 0.0 or seconds > self._config.max_gap:
            return np.eye(4)
        return boxplus(np.eye(4), self._step * (seconds / self._step_seconds))

    def _register(self, scan: FloatArray, guess: FloatArray) -> RegistrationResult:
        target = self._map.target
        assert target is not None
        config = self._config.registration
        local_guess = invert_transform(self._map.newest.T) @ guess
        result = self._plausible(register(scan, target, local_guess, config), local_guess)
        if not result.converged and self._failures >= self._config.search_after:
            return register(scan, target, None, config)
        return result

    def _plausible(self, result: RegistrationResult, guess: FloatArray) -> RegistrationResult:
        """The result, as a failure where it lies too far from the guess."""
        correction = boxminus(result.T_target_source, guess)
        distance, angle = np.linalg.norm(correction[:3]), np.rad2deg(np.linalg.norm(correction[3:]))
        if result.converged and (distance > self._config.max_correction or angle > self._config.max_correction_deg):
            reason = f"implausible: {distance:.2f} m and {angle:.1f} deg from the guess"
            return replace(result, converged=False, reason=reason)
        return replace(result, covariance=self._bounded(result.covariance)) if result.converged else result

    def _bounded(self, covariance: FloatArray) -> FloatArray:
        """Covariance of a pose that also lies near the guess, as the limits of corrections assume: a uniform
        distribution between the limits has a third of their square as variance.

        Without it each scan of a single wall would let metres of uncertainty into the trajectory.
        """
        limits = np.repeat([self._config.max_correction, np.deg2rad(self._config.max_correction_deg)], 3)
        prior = np.diag(limits**2 / 3.0)
        bounded = prior @ np.linalg.solve(covariance + prior, covariance)  # the sum of both informations, inverted
        return np.asarray(0.5 * (bounded + bounded.T))

    def _track(self, stamp_ns: int, scan: FloatArray, result: RegistrationResult) -> OdometryResult:
        keyframe = self._map.newest
        # Rounding in a product of rotations doubles with every transposition: a chain must be made orthonormal again.
        T = transform_from_pose7(pose7_from_transform(keyframe.T @ result.T_target_source))
        covariance = compose_covariance(keyframe.T, keyframe.covariance, result.T_target_source, result.covariance)
        motion = self._motion(stamp_ns, result) if self._tracked else None
        self._step = boxminus(invert_transform(self._T) @ T, np.eye(4)) if self._tracked else np.zeros(6)
        self._step_seconds = 1e-9 * (stamp_ns - self._stamp_ns)
        self._stamp_ns, self._T, self._covariance = stamp_ns, T, covariance
        self._local = (result.T_target_source, result.covariance)
        self._failures, self._tracked = 0, True
        if self._is_keyframe(result):
            self._map.add(T, covariance, scan)
            self._local = (np.eye(4), 1e-12 * np.eye(6))
        return OdometryResult(stamp_ns, T, covariance, motion, OdometryStatus.TRACKING, result.reason, result)

    def _motion(self, stamp_ns: int, result: RegistrationResult) -> RelativeMotion:
        """Motion since the last scan: both were registered to the same keyframe, each with its own error."""
        T_last, covariance_last = self._local
        inverse = invert_transform(T_last)
        J = inverse_jacobian(T_last)
        covariance = compose_covariance(inverse, J @ covariance_last @ J.T, result.T_target_source, result.covariance)
        return RelativeMotion(self._stamp_ns, stamp_ns, inverse @ result.T_target_source, covariance)

    def _is_keyframe(self, result: RegistrationResult) -> bool:
        c = self._config
        moved = boxminus(result.T_target_source, np.eye(4))
        return bool(
            result.overlap < c.keyframe_overlap
            or np.linalg.norm(moved[:3]) > c.keyframe_distance
            or np.rad2deg(np.linalg.norm(moved[3:])) > c.keyframe_angle_deg
        )

    def _fail(self, stamp_ns: int, scan: FloatArray, guess: FloatArray, result: RegistrationResult) -> OdometryResult:
        seconds = 1e-9 * (stamp_ns - self._stamp_ns)
        self._failures += 1
        self._tracked = False
        sigma = np.repeat([self._config.acceleration_sigma, self._config.angular_acceleration_sigma], 3)
        elapsed = seconds * max(self._failures, 1)
        self._covariance = self._covariance + np.diag((0.5 * sigma * seconds * elapsed) ** 2)
        self._stamp_ns, self._T = stamp_ns, guess
        self._step_seconds = max(self._step_seconds, 0.0)
        if self._failures >= self._config.restart_after and len(scan) >= self._config.registration.min_points:
            return self._restart(stamp_ns, scan, result)
        return OdometryResult(stamp_ns, guess, self._covariance, None, OdometryStatus.FAILED, result.reason, result)

    def _restart(self, stamp_ns: int, scan: FloatArray, result: RegistrationResult) -> OdometryResult:
        self._map.clear()
        self._step = np.zeros(6)
        self._failures = 0
        started = self._start(stamp_ns, scan)
        status = OdometryStatus.RESTARTED if started.status is OdometryStatus.STARTED else OdometryStatus.FAILED
        return replace(started, status=status, reason=f"map started anew: {result.reason}", registration=result)
