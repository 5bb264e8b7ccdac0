# SPDX-License-Identifier: Apache-2.0
"""Velocity, gravity and the biases of an IMU, in one filter that goes on from submap to submap.

State at the newest linked frame, along the rig's axes there: velocity of the IMU v, gravity g, biases b_g and b_a of
gyroscope and accelerometer, and what is to be added to the IMU's stamps, s (Li and Mourikis 2014). Preintegrated
readings (``preintegration``) predict the motion to the next frame,

    R = R_pre,   p = v dt + g dt^2 / 2 + p_pre,   v <- R' (v + g dt + v_pre),   g <- R' g,

and the motion that the images show measures it. All is relative to the rig itself: no map frame, no start at rest and
no heading is needed, and nothing changes when a submap ends. Gravity starts as what the accelerometer reads, as
uncertain as a hand may shake it, and becomes known, as do the biases, by the motions of the first seconds.

The images' motions stay what the map is made from. What comes out of here bridges frames without any (a blackout),
predicts turns, and says which way is up.

An accelerometer that reads something else (in g, without gravity, along other axes) contradicts the images: then it is
left out, with a reason, and the gyroscope is used alone.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.config import InertialConfig, MotionConfig
from ekf_slam_node.odometry.clock_watch import FARTHEST_S, ClockWatch
from ekf_slam_node.odometry.preintegration import ImuNoise, Preintegral
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus, make_transform, skew, so3_exp
from slam_core.types import GRAVITY

_GATE = chi_square_bound(0.999, 3)
_HAND_SHAKE = 2.0
"""By how much (m/s2) the first readings may differ from gravity, each axis."""
_GYROSCOPE_BIAS_WALK = 1e-4
"""Change (rad/s) of a gyroscope's bias within a second, growing with the root of the time."""
_ACCELEROMETER_BIAS_WALK = 1e-3
"""Change (m/s2) of an accelerometer's bias within a second, growing with the root of the time."""
_CLOCK_WALK = 1e-5
"""Change (s) of the clocks' difference within a second, growing with the root of the time."""
_GRAVITY_SPREAD = 0.03
"""Spread (m/s2) of gravity's size over the earth, with an accelerometer's scale."""
_GRAVITY_RANGE = (0.8, 1.25)
"""Mean specific force of the first second, over gravity, of an accelerometer that can be meant."""
_FIRST_S = 1.0
_FORGETTING = 0.95
"""Weight of the past in the running mean of the normalised errors: twenty frames."""
_MIN_JUDGED_STEPS = 20
"""Motions after which the accelerometer is judged, and may bridge."""
_CONTRADICTION = 8.0
"""Mean normalised error squared, 1 if all is as claimed, beyond which an accelerometer is left out."""
_LARGEST_ERROR = 20.0
"""Larger ones count as this: a few frames that are wrong themselves do not condemn an IMU."""
_PROVEN = 4.0
"""Mean normalised error squared of the turns below which an IMU is believed: it may refute four frames in a row."""
_KNOWN = 0.5
"""Standard deviation (m/s2) of each axis of gravity below which its direction is known."""
_UPRIGHT = np.radians(2.0)
"""Gravity must be known to this angle before anything is bridged."""

V, G, B = slice(0, 3), slice(3, 6), slice(6, 13)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Motion over dt (s).

    T: (4, 4) of the IMU's place, along the rig's axes. velocity, gravity: (3,) at the end, along the axes of the
    start. covariance: (19, 19) of the errors of (p, turn, velocity, gravity, biases, time offset).
    """

    dt: float
    T: FloatArray
    velocity: FloatArray
    gravity: FloatArray
    covariance: FloatArray
    pre: Preintegral


class InertialFilter:
    """Thirteen states of a rig with an IMU; see the module.

    velocity, gravity: (3,) m/s and m/s2; biases: (6,) rad/s and m/s2; time_offset: s; covariance: (13, 13) of all, in
    this order.
    ``uses_force``: whether the accelerometer is used; ``uses_turns``: whether the IMU is used at all; ``diagnostic``
    says why not, or is "" (also where there is no accelerometer).
    """

    def __init__(self, motion: MotionConfig, config: InertialConfig) -> None:
        self._motion = motion
        self.noise = ImuNoise(
            config.gyroscope_noise_density,
            config.accelerometer_noise_density,
            motion.sigma_initial_turn_rate,
            motion.sigma_acceleration,
        )
        self.biases, self.time_offset = np.zeros(6), 0.0
        self.covariance = np.zeros((13, 13))
        sigma = np.append(np.repeat([config.gyroscope_bias, config.accelerometer_bias], 3), config.sigma_time_offset)
        self.covariance[B, B] = np.diag(sigma**2)
        self._clock = ClockWatch(config.gyroscope_bias) if config.sigma_time_offset > 0.0 else None
        self.uses_force, self.uses_turns, self.diagnostic = True, True, ""
        self._variance_scale, self._turn_variance_scale, self._judged = 1.0, 1.0, 0
        self._first_force = self._first_s = 0.0
        self.forget_motion()

    def fork(self) -> InertialFilter:
        """A filter of its own with this one's state."""
        other = copy.copy(self)
        other._clock = copy.copy(self._clock)
        return other

    def forget_motion(self, gravity: FloatArray | None = None) -> None:
        """Velocity and gravity are unknown from here on: readings were missing. The biases and the clock stay.

        gravity: (3,) m/s2, to tell the vertical until the next reading.
        """
        self.velocity, self.gravity = np.zeros(3), np.zeros(3)
        biases = self.covariance[B, B].copy()
        self.covariance = np.zeros((13, 13))
        self.covariance[B, B] = biases
        if gravity is not None:
            self.gravity, self.covariance[G, G] = gravity, np.eye(3) * _HAND_SHAKE**2
        self._steps = 0
        self._is_sized = False

    @property
    def gyro_bias_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the gyroscope's bias, rad2/s2."""
        return self.covariance[6:9, 6:9]

    @property
    def sigma_time_offset(self) -> float:
        """Standard deviation of the time offset, s."""
        return float(np.sqrt(self.covariance[12, 12]))

    @property
    def variance_scale(self) -> float:
        """Running mean of the ways' normalised squared errors, 1 if all is as claimed."""
        return self._variance_scale

    @property
    def sigma_velocity(self) -> FloatArray:
        """Standard deviations (3,) of the velocity, m/s."""
        return np.sqrt(max(self._variance_scale, 1.0) * np.diagonal(self.covariance[V, V]))

    @property
    def can_bridge(self) -> bool:
        """True if velocity and gravity are known well enough to go on without images."""
        return self.uses_force and self._steps >= _MIN_JUDGED_STEPS and self.sigma_tilt < _UPRIGHT

    @property
    def is_proven(self) -> bool:
        """True if the turn rates have agreed with the images so far: they are believed when a motion does not."""
        return self.uses_turns and self._judged > 0 and self._turn_variance_scale < _PROVEN

    @property
    def up(self) -> FloatArray:
        """Unit vector (3,) upwards along the rig's axes; meaningful where ``sigma_tilt`` is small."""
        return np.asarray(-self.gravity / max(float(np.linalg.norm(self.gravity)), 1e-9))

    @property
    def tilt_covariance(self) -> FloatArray:
        """Covariance (3, 3) of ``up``, singular along it."""
        across = (np.eye(3) - np.outer(self.up, self.up)) / GRAVITY
        return np.asarray(max(self._variance_scale, 1.0) * across @ self.covariance[G, G] @ across)

    @property
    def sigma_tilt(self) -> float:
        """Standard deviation (rad) of ``up``, the larger one of its two axes; pi where nothing is known."""
        if self._steps == 0 or not self.uses_force:
            return float(np.pi)
        return float(np.sqrt(np.linalg.eigvalsh(self.tilt_covariance)[-1]))

    # ------------------------------------------------------------------------------------------------------ steps
    def predict(self, pre: Preintegral) -> Prediction:
        """The motion over a preintegral that was made with these biases."""
        if self._steps == 0:
            self.gravity = -pre.force
            self.covariance[V, V] = np.eye(3) * self._motion.sigma_initial_velocity**2
            self.covariance[G, G] = np.eye(3) * _HAND_SHAKE**2
        dt = pre.dt
        F = np.zeros((19, 13))
        F[:3, V], F[:3, G], F[:3, B] = np.eye(3) * dt, np.eye(3) * (0.5 * dt**2), pre.J[6:]
        F[3:6, B] = pre.J[:3]
        F[6:9, V], F[6:9, G], F[6:9, B] = np.eye(3), np.eye(3) * dt, pre.J[3:6]
        F[9:12, G], F[12:, B] = np.eye(3), np.eye(7)
        covariance = F @ self.covariance @ F.T
        rows = np.array([3, 4, 5, 6, 7, 8, 0, 1, 2])
        covariance[np.ix_(rows, rows)] += pre.covariance
        clock_walk = _CLOCK_WALK if self._clock is not None else 0.0
        walk = np.append(np.repeat([_GYROSCOPE_BIAS_WALK, _ACCELEROMETER_BIAS_WALK], 3), clock_walk)
        covariance[12:, 12:] += np.diag(walk**2 * dt)
        p = self.velocity * dt + 0.5 * self.gravity * dt**2 + pre.p
        velocity = self.velocity + self.gravity * dt + pre.v
        return Prediction(dt, make_transform(pre.R, p), velocity, self.gravity, covariance, pre)

    def motion_covariance(self, step: Prediction) -> FloatArray:
        """Covariance (6, 6) of a predicted motion, larger by as much as predictions so far were off."""
        return np.asarray(max(self._variance_scale, 1.0) * step.covariance[:6, :6])

    def advance(self, step: Prediction) -> None:
        """Move on to the end of a prediction; nothing else is known of the motion."""
        self._move(step, np.zeros(19), step.covariance)

    def measure(self, step: Prediction, T: FloatArray, covariance: FloatArray) -> bool:
        """Move on to the end of a prediction, of which the images show the motion T (4, 4) +- covariance (6, 6).

        T is that of the IMU's place along the rig's axes. False if the two contradict each other.
        """
        error = boxminus(T, step.T)
        step = self._with_clock_checked(step, error[3:], covariance[3:, 3:])
        S = step.covariance[:6, :6] + covariance * max(self._variance_scale, 1.0)
        squared = _normalised(error[3:], S[3:, 3:])
        self._judge_turns(squared / 3.0)
        turns = squared < _GATE
        moves = turns and self.uses_force
        if moves:
            squared = _normalised(error[:3], S[:3, :3])
            self._judge(squared * max(self._variance_scale, 1.0) / 3.0)
            moves = squared < _GATE
        rows = np.arange(0 if moves else 3, 6 if turns else 3)
        cross = step.covariance[:, rows]
        gain = np.linalg.solve(S[np.ix_(rows, rows)], cross.T).T
        P = step.covariance - gain @ cross.T
        if not moves:  # a shock: the velocity is not what it was
            P[6:9, 6:9] += np.eye(3) * float(error[:3] @ error[:3]) / step.dt**2
        self._move(step, gain @ error[rows], 0.5 * (P + P.T))
        return moves or (turns and not self.uses_force)

    def _with_clock_checked(self, step: Prediction, turn_error: FloatArray, covariance: FloatArray) -> Prediction:
        """The prediction, its clock as uncertain as the turns of all frames so far show it to be."""
        if self._clock is None:
            return step
        pre = step.pre
        known = pre.J[:3, :3] @ self.biases[:3] + pre.J[:3, 6] * self.time_offset
        self._clock.add(pre, turn_error + known, covariance + pre.covariance[:3, :3])
        wider = self._clock.contradicted(self.time_offset, self.sigma_time_offset)
        if not wider:
            return step
        change = np.zeros(19)
        change[:3], change[3:6], change[6:9], change[18] = pre.J[6:, 6], pre.J[:3, 6], pre.J[3:6, 6], 1.0
        return replace(step, covariance=step.covariance + wider * np.outer(change, change))

    def check_specific_force(self, pre: Preintegral) -> None:
        """Judge the specific force of the first second: gravity is the most of it, whatever a hand does."""
        if self._first_s >= _FIRST_S:
            return
        self._first_force += pre.reading * pre.dt
        self._first_s += pre.dt
        mean, (low, high) = self._first_force / self._first_s, _GRAVITY_RANGE
        if self._first_s >= _FIRST_S and not low < mean / GRAVITY < high:
            told = f"accelerometer left out: it reads {mean:.2f} m/s2 where gravity has 9.81 (REP-145: with gravity)"
            self._leave_out(told if mean > 0.0 else "")

    def add_inconsistency(self) -> None:
        """The images tell another turn by far, and are not believed: it may be the IMU that is wrong."""
        self._judge_turns(_LARGEST_ERROR)

    # ----------------------------------------------------------------------------------------------------- inside
    def _leave_out(self, diagnostic: str) -> None:
        self.uses_force, self.diagnostic, self._variance_scale = False, diagnostic, 1.0

    def _judge(self, normalised: float) -> None:
        """Take a normalised squared error of the way, 1 if all is as claimed, into the running mean."""
        self._variance_scale = _followed(self._variance_scale, normalised)
        if self._judged >= _MIN_JUDGED_STEPS and self._variance_scale > _CONTRADICTION:
            self._leave_out("accelerometer left out: it contradicts the images (check mounting, stamps and units)")

    def _judge_turns(self, normalised: float) -> None:
        self._judged += 1
        self._turn_variance_scale = _followed(self._turn_variance_scale, normalised)
        if self._judged >= _MIN_JUDGED_STEPS and self._turn_variance_scale > _CONTRADICTION:
            self.uses_turns = False
            self._leave_out("IMU left out: its turn rates contradict the images (check mounting, stamps and units)")

    def _move(self, step: Prediction, correction: FloatArray, covariance: FloatArray) -> None:
        turn = so3_exp(correction[3:6]) @ step.T[:3, :3]
        velocity, gravity = step.velocity + correction[6:9], step.gravity + correction[9:12]
        self.velocity, self.gravity = turn.T @ velocity, turn.T @ gravity
        self._correct_sensor(correction[12:])
        M = np.zeros((13, 19))
        M[V, 6:9] = M[G, 9:12] = turn.T
        M[V, 3:6], M[G, 3:6] = turn.T @ skew(velocity), turn.T @ skew(gravity)
        M[B, 12:] = np.eye(7)
        self.covariance = M @ covariance @ M.T
        self._steps += 1
        if not self._is_sized and np.linalg.eigvalsh(self.covariance[G, G])[-1] < _KNOWN**2:
            self._size_gravity()

    def _size_gravity(self) -> None:
        """Once its direction is known: gravity has the same size everywhere, what differs is the bias."""
        self._is_sized = True
        cross = self.covariance[:, G] @ -self.up
        S = float(cross[G] @ -self.up) + _GRAVITY_SPREAD**2
        delta = cross * ((GRAVITY - float(np.linalg.norm(self.gravity))) / S)
        self.velocity, self.gravity = self.velocity + delta[V], self.gravity + delta[G]
        self._correct_sensor(delta[B])
        self.covariance = self.covariance - np.outer(cross, cross) / S

    def _correct_sensor(self, delta: FloatArray) -> None:
        self.biases = self.biases + delta[:6]
        self.time_offset = float(np.clip(self.time_offset + delta[6], -FARTHEST_S, FARTHEST_S))


def _followed(mean: float, normalised: float) -> float:
    """A running mean with one more value."""
    return _FORGETTING * mean + (1.0 - _FORGETTING) * min(normalised, _LARGEST_ERROR)


def _normalised(error: FloatArray, S: FloatArray) -> float:
    return float(error @ np.linalg.solve(S, error))


def at_place(T: FloatArray, covariance: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motion T (4, 4) of a rig as the motion of a ``place`` (3,) on it, axes unchanged, with its covariance (6, 6)."""
    arm = T[:3, :3] @ place
    J = np.eye(6)
    J[:3, 3:] = -skew(arm)
    return make_transform(T[:3, :3], T[:3, 3] + arm - place), J @ covariance @ J.T
