# SPDX-License-Identifier: Apache-2.0
"""Odometry of wheels, legs or another estimator: calibrated by the images, and dead reckoning where these see nothing.

What is wrong with an odometry for good is learnt from the motions that the images show: the scale of
its way (the wheels' radius), that of its turns (their distance), and the yaw of its mounting. A step of its frame with
rotation R, a turn t about its z axis and way p is taken as

    p <- (1 + s) Rz(yaw) p,    R <- Rz(yaw) Rz(k t) R Rz(yaw)'

What is wrong by chance is noise that grows with the way: as large as claimed, larger by as much as the images
contradict, and where nothing is claimed as large as they show. A window of two seconds that contradicts them beyond the
gate is slip: nothing is learnt from it. In the dark a gyroscope takes the turns over, and tells slip by them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.config import ExternalOdometryConfig
from ekf_slam_node.odometry.pose_readings import PoseReadings
from ekf_slam_node.odometry.preintegration import Preintegral
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import (
    FloatArray,
    both_halves,
    boxminus,
    compose_covariance,
    compose_jacobians,
    invert_transform,
    make_transform,
    rotation_from_euler,
    so3_log,
)
from slam_core.types import OdometryReading

Turns = Callable[[int, int], Preintegral | None]
"""Preintegral of an IMU between two stamps, if its turns are to be believed."""

_GATE, _TURN_GATE = chi_square_bound(0.999, 6), chi_square_bound(0.999, 1)
_LONGEST_STEP_NS = 100_000_000
"""Longer times are reckoned in parts."""
_KEPT_NS = 10_000_000_000
"""Readings of so long ago are forgotten in the dark."""
_WINDOW_S, _FEWEST = 2.0, 3
"""Motions of images are compared over this time, and so many frames: slip lasts for less."""
_MAX_WINDOWS, _WINDOWS_BEFORE = 10, 2
"""The noise's size is a mean over so many windows; what is believed before counts as so many."""
_UNSEEN = 4.0
"""The noise's size before a window has told of it, where nothing is claimed."""
_MARGIN = 2.0
"""A size that is known from so few windows may be larger by so much."""
_LEAST, _LARGEST = 0.05, 1e4
"""Limits of the noise's size, as a share of the model's variances; of what is claimed, 1 is the least."""
_OUTLIER = 20.0
"""Larger normalised errors count as this."""
_CONTRADICTION = 100.0
"""Size of the noise beyond which a user should know."""
_LASTING_STEPS = 20.0
"""Steps of a submap that share the calibration's error."""
_SIGMA_VELOCITY = 0.3
"""By how much (m/s, rad/s) the velocity of a moment may differ from its mean over the newest step."""
_SLIPPED = 0.5
"""Share of a slipping step that may be wrong."""
_CALIBRATION_WALK = np.array([2e-4, 2e-4, 1e-4])
"""Change of the calibration from window to window."""

_GROUPS = (np.array([0, 1]), np.array([2]), np.array([3, 4]), np.array([5]))
"""Axes whose noise has one size."""
C, B = slice(6, 9), slice(9, 12)


@dataclass(frozen=True, eq=False)
class Reckoning:
    """Motion ``T`` (4, 4) of the rig since a stamp, and the way (m) that led there.

    covariance: (12, 12) of its error, the calibration (way, turns, yaw), and a gyroscope's bias. transition: (12, 12)
    derivative of these errors with respect to those at the start, at ``start_ns``.
    """

    start_ns: int
    stamp_ns: int
    T: FloatArray
    covariance: FloatArray
    transition: FloatArray
    travelled: float = 0.0

    def covariance_with(self, earlier: Reckoning | None) -> FloatArray | None:
        """Covariance (6, 6) of an earlier motion's error with this one's; None if that has another start."""
        if earlier is None or earlier.start_ns != self.start_ns:
            return None
        since = self.transition @ np.linalg.inv(earlier.transition)
        return np.asarray((earlier.covariance @ since.T)[:6, :6])


@dataclass(frozen=True, eq=False)
class _Window:
    """Motion that the images have shown since the start of a reckoning, with its covariance (6, 6)."""

    start: Reckoning
    end_ns: int
    T: FloatArray
    covariance: FloatArray
    frames: int = 0


class ExternalOdometry:
    """One odometry.

    calibration: (3,) error of the way's scale, of the turns' scale, and yaw rad; covariance: (3, 3). ``noise``: (6,)
    factors on the variances of its steps. ``slips``: steps and windows that were not believed.
    """

    def __init__(self, config: ExternalOdometryConfig) -> None:
        self._config = config
        self.readings = PoseReadings()
        self.calibration = np.zeros(3)
        sigma = np.array([config.sigma_scale, config.sigma_turn_scale, np.radians(config.sigma_yaw_deg)])
        self.covariance = np.diag(sigma**2)
        self.noise = np.ones(6)
        self.windows = self.slips = 0
        self._window: _Window | None = None
        self._reckoned = [self._begin(-1, None)]

    @property
    def is_heard(self) -> bool:
        """True if there is such an odometry."""
        return self.readings.newest is not None

    @property
    def finding(self) -> str:
        """The calibration as it was learnt, and what was estimated for want of a covariance; "" without an odometry."""
        if not self.is_heard:
            return ""
        s, k, yaw = self.calibration
        e_s, e_k, e_yaw = np.sqrt(np.diagonal(self.covariance))
        text = (
            f"odometry: way x {1.0 + s:.4f} +- {e_s:.4f}, turns x {1.0 + k:.4f} +- {e_k:.4f}, "
            f"yaw {np.degrees(yaw):+.2f} +- {np.degrees(e_yaw):.2f} deg"
        )
        return f"{text}; {self.estimated}" if self.estimated else text

    @property
    def estimated(self) -> str:
        """The axes whose noise the images tell, since no covariance does, in words; "" if there are none."""
        names = np.array(["x", "y", "z", "roll", "pitch", "yaw"])[~self.readings.claimed]
        if not self.is_heard or not len(names):
            return ""
        return f"no usable covariance of {', '.join(names)}: estimated from the images"

    @property
    def diagnostic(self) -> str:
        """Complaint about the odometry, or ""."""
        if self.noise.max() < _CONTRADICTION:
            return ""
        return "odometry contradicts the images (check child_frame_id, its mounting and stamps): it counts for little"

    def add(self, reading: OdometryReading) -> str:
        """Take a reading; returns why it is rejected, or ""."""
        return self.readings.add(reading)

    # ------------------------------------------------------------------------------------------------ dead reckoning
    def reckon(self, start_ns: int, end_ns: int, turns: Turns, bias: FloatArray | None = None) -> Reckoning | None:
        """Motion between two stamps, None where readings are missing; quick if the start is that of the last call.

        ``turns``: of an IMU, used instead of the odometry's; ``bias``: (3, 3) covariance of its gyroscope's bias.
        """
        if start_ns != self._reckoned[0].stamp_ns:
            self._reckoned = [self._begin(start_ns, bias)]
        # The newest two are kept: a frame may turn out to be of use when the next one has come.
        before = [state for state in self._reckoned if state.stamp_ns <= end_ns]
        if before[-1].stamp_ns < end_ns:
            if not self.readings.covers(before[-1].stamp_ns, end_ns):
                return None
            before.append(self._advanced(before[-1], end_ns, turns))
            self._reckoned = [before[0], *before[1:][-2:]]
            self._forget_reckoned()
        return before[-1]

    def _forget_reckoned(self) -> None:
        """After a while in the dark only the newest readings are needed, and the images' last window is over."""
        if self._reckoned[-1].stamp_ns - self._reckoned[0].stamp_ns > _KEPT_NS:
            self._window = None
            self.readings.forget_before(self._reckoned[1].stamp_ns)

    def between(self, reckoned: Reckoning) -> FloatArray:
        """Covariance (6, 6) of a motion that is one of many in a row: these share the calibration's error."""
        cross = reckoned.covariance[:6, C]
        shared = cross @ np.linalg.solve(reckoned.covariance[C, C], cross.T)
        return np.asarray(reckoned.covariance[:6, :6] + (_LASTING_STEPS - 1.0) * shared)

    def velocity(self) -> tuple[FloatArray, FloatArray] | None:
        """Mean velocity (6,) of the rig over the newest tenth of a second with standard deviations (6,), if known."""
        newest = self.readings.newest
        if newest is None or not self.readings.covers(newest.stamp_ns - _LONGEST_STEP_NS, newest.stamp_ns):
            return None
        dt = _LONGEST_STEP_NS * 1e-9
        start = self._begin(newest.stamp_ns - _LONGEST_STEP_NS, None)
        step = self._advanced(start, newest.stamp_ns, lambda start, end: None)
        return boxminus(step.T, np.eye(4)) / dt, np.full(6, _SIGMA_VELOCITY)

    def _begin(self, stamp_ns: int, bias: FloatArray | None) -> Reckoning:
        covariance = np.zeros((12, 12))
        covariance[C, C] = self.covariance
        if bias is not None:
            covariance[B, B] = bias
        return Reckoning(stamp_ns, stamp_ns, np.eye(4), covariance, np.eye(12))

    def _advanced(self, state: Reckoning, end_ns: int, turns: Turns) -> Reckoning:
        while state.stamp_ns < end_ns:
            state = self._step(state, min(end_ns, state.stamp_ns + _LONGEST_STEP_NS), turns)
        return state

    def _step(self, state: Reckoning, end_ns: int, turns: Turns) -> Reckoning:
        own, variance = self.readings.motion(state.stamp_ns, end_ns)
        assert self.readings.newest is not None
        mount = self.readings.newest.T_rig_frame
        T, J = calibrated(own, self.calibration)
        noise, J_bias = np.diag(variance * self._sizes()), np.zeros((6, 3))
        pre = turns(state.stamp_ns, end_ns)
        if pre is not None:
            slipped = self._slips_by_turn(T, J, noise, pre, state, mount)
            noise[:2, :2] += np.eye(2) * (_SLIPPED * np.linalg.norm(own[:3, 3])) ** 2 * slipped
            to_frame = mount[:3, :3].T
            T[:3, :3] = to_frame @ pre.R @ to_frame.T
            J[3:] = 0.0
            J_bias[3:] = to_frame @ pre.J[:3, :3]
            noise[3:, 3:] = to_frame @ pre.covariance[:3, :3] @ to_frame.T
        onward = T @ invert_transform(mount)
        to_rig = compose_jacobians(mount, onward)[1] @ compose_jacobians(T, invert_transform(mount))[0]
        step = mount @ onward
        J_state, J_step = compose_jacobians(state.T, step)
        J_step = J_step @ to_rig
        F = np.eye(12)
        F[:6, :6], F[:6, C], F[:6, B] = J_state, J_step @ J, J_step @ J_bias
        P = F @ state.covariance @ F.T
        P[:6, :6] += J_step @ noise @ J_step.T
        way = state.travelled + float(np.linalg.norm(own[:3, 3]))
        return Reckoning(state.start_ns, end_ns, state.T @ step, 0.5 * (P + P.T), F @ state.transition, way)

    def _slips_by_turn(
        self, T: FloatArray, J: FloatArray, noise: FloatArray, pre: Preintegral, state: Reckoning, mount: FloatArray
    ) -> bool:
        """True if wheels and gyroscope tell different turns about the frame's z axis."""
        axis = mount[:3, 2]
        error = float(axis @ so3_log(pre.R.T @ mount[:3, :3] @ T[:3, :3] @ mount[:3, :3].T))
        of_bias = axis @ pre.J[:3, :3]
        S = noise[5, 5] + J[5] @ self.covariance @ J[5] + of_bias @ state.covariance[B, B] @ of_bias
        slips = error**2 > _TURN_GATE * float(S + axis @ pre.covariance[:3, :3] @ axis)
        self.slips += slips
        return slips

    # ------------------------------------------------------------------------------------------------------ learning
    def forget_motion(self) -> None:
        """The images have shown no motion for a while: the next window begins anew."""
        self._window = None

    def learn(self, start_ns: int, end_ns: int, T: FloatArray, covariance: FloatArray) -> bool:
        """Take a motion (4, 4) that the images show alone, with its covariance (6, 6); False if a window contradicts.

        Motions are strung together to windows of two seconds.
        """
        window = self._window
        if window is None or window.end_ns != start_ns:
            window = _Window(self._begin(start_ns, None), start_ns, np.eye(4), np.zeros((6, 6)))
        together = compose_covariance(window.T, window.covariance, T, covariance)
        window = replace(window, end_ns=end_ns, T=window.T @ T, covariance=together, frames=window.frames + 1)
        self._window = window
        if (end_ns - window.start.stamp_ns) * 1e-9 < _WINDOW_S or window.frames < _FEWEST:
            return True
        self._window = None
        if not self.readings.covers(window.start.stamp_ns, end_ns):
            return True
        return self._measure(window, self._advanced(window.start, end_ns, lambda start, end: None))

    @property
    def window_start_ns(self) -> int | None:
        """Stamp from which readings are still needed for learning."""
        return None if self._window is None else self._window.start.stamp_ns

    def _measure(self, window: _Window, reckoned: Reckoning) -> bool:
        self.noise = self.noise if self.windows else self._sizes()
        self.windows += 1
        error = boxminus(window.T, reckoned.T)
        P = reckoned.covariance
        S = P[:6, :6] + window.covariance
        self._size_noise(error, S, window, reckoned)
        if not float(error @ np.linalg.solve(S, error)) < _GATE:
            self.slips += 1
            return False
        gain = np.linalg.solve(S, P[:6, C]).T
        self.calibration = self.calibration + gain @ error
        learnt = self.covariance - gain @ P[:6, C] + np.diag(_CALIBRATION_WALK**2)
        self.covariance = 0.5 * (learnt + learnt.T)
        return True

    def _sizes(self) -> FloatArray:
        if not self.windows:
            return np.where(self.readings.claimed, 1.0, _UNSEEN)
        return np.where(self.readings.claimed, np.maximum(self.noise, 1.0), np.maximum(_MARGIN * self.noise, _LEAST))

    def _size_noise(self, error: FloatArray, S: FloatArray, window: _Window, reckoned: Reckoning) -> None:
        """Follow the noise's size, axis by axis of the odometry's frame: what the error has beyond all else."""
        assert self.readings.newest is not None
        turn = both_halves(self.readings.newest.T_rig_frame[:3, :3].T)
        error, variance = turn @ error, np.diagonal(turn @ S @ turn.T)
        _, claimed = self.readings.motion(window.start.stamp_ns, reckoned.stamp_ns)
        beyond = np.minimum(error**2, _OUTLIER * variance) - (variance - claimed * self._sizes())
        share = 1.0 / min(self.windows + _WINDOWS_BEFORE, _MAX_WINDOWS)
        for axes in _GROUPS:
            seen = float(beyond[axes].mean() / claimed[axes].mean())
            self.noise[axes] = np.clip((1.0 - share) * self.noise[axes] + share * seen, _LEAST, _LARGEST)


def calibrated(T: FloatArray, calibration: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A step T (4, 4) of the odometry's frame with its calibration (3,), and the derivative (6, 3) of its error."""
    s, k, yaw = calibration
    z = np.array([0.0, 0.0, 1.0])
    turn = float(so3_log(T[:3, :3])[2])
    Rz = rotation_from_euler(yaw)
    R = Rz @ rotation_from_euler(k * turn) @ T[:3, :3] @ Rz.T
    p = (1.0 + s) * Rz @ T[:3, 3]
    J = np.zeros((6, 3))
    J[:3, 0], J[:3, 2] = Rz @ T[:3, 3], np.cross(z, p)
    J[3:, 1], J[3:, 2] = turn * z, z - R @ z
    return make_transform(R, p), J
