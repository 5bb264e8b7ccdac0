# SPDX-License-Identifier: Apache-2.0
"""Rows that are exposed one after the other: the time between them, learnt, and features moved to one instant.

A camera with a rolling shutter sees its top and bottom from different poses. A point seen at a row that was exposed t
after the middle one lies, for the camera of the middle row, where the rig's motion in t has brought it (Hedborg et al.
2012). The readout, time from the first row to the last, is learnt from pairs of frames with a motion between them that
has changed: at a constant velocity both are bent alike, which no pair can tell. A frame's velocity is the mean of the
motions before and after it. A camera whose rows are exposed at once shows no readout beyond chance and stays as it is.
The frames of several cameras are left as they are: each would have a readout of its own.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ekf_slam_node.association.motion_guess import refine_motion
from ekf_slam_node.association.pair_kernels import PairErrors, pair_errors, readout_equations
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.measurement_kernels import moved_measurements, rolling_rates
from ekf_slam_node.filtering.models import Frame, rig_points, velocity_of_motion
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.least_squares import MAD_TO_SIGMA
from slam_core.geometry import FloatArray

_APART = 3
"""Frames from one of a pair to the other, where the two share enough."""
_MIN_SHARED = 20
"""Landmarks that both frames of a pair must see."""
_LEAST_SCALE = 1e-9
"""Scatter of values in their sigma where more than half of them are equal."""
_GROUP = 4
"""Neighbouring pairs that are not independent."""
_CERTAIN = 6.0
"""Standard errors by which the readout must differ from zero."""
_DOUBTED = 2.0
"""Standard errors below which a readout that was certain no longer is."""
_BOUND = 1.5
"""Pairs of frames further from the mean, in robust standard deviations, count as being so far."""
_MIN_FRAME_PAIRS, _FRAMES_PER_ESTIMATE = 60, 4
"""Pairs of frames from which on only one in so many is looked at, which saves a millisecond a frame."""
_MAX_FRAME_PAIRS = 400
"""Pairs of frames remembered."""
_MIN_PAIRS = 16
"""Pairs of frames before which nothing is corrected."""
_PAIR_SIGMA_S = 0.005
"""Error of the readout of a single pair beside its noise: velocities are known from motions between frames only."""
_LONGEST_READOUT_S = 0.1
"""A pair that shows more shows something else."""
_SMOOTHING = np.array([0.75, 0.5, -0.25])
"""Weights of the last three velocities, newest first: their mean is half a step old, as that of the newest alone, but
what alternates from frame to frame cancels. A wrong velocity bends a frame, which makes the next motion wrong to the
other side; fed back, that grows.
"""
_STEP_S = 1e-3
"""Readout by which derivatives are taken."""
_GATE = chi_square_bound(0.999, 3)
_HUBER = 2.5
"""Errors beyond so many standard deviations count less."""
_LONGEST_STEP_S = 0.25
"""Longest time between frames whose motion tells a velocity."""


@dataclass(frozen=True, eq=False)
class _FramePair:
    """A frame as it was measured, ids and columns (k,) of its landmarks.

    The motion that led to it within some time and its velocity (6,).
    """

    frame: Frame
    ids: np.ndarray
    columns: np.ndarray
    T_previous_now: FloatArray
    velocity: FloatArray


class RollingShutter:
    """Running estimate of the time from the first row of a picture to its last.

    Parameters
    ----------
    T_rig_optical
        Mounting of the camera, (4, 4).
    known
        Readout and its standard deviation, s, as known beforehand; nothing is where the latter is zero.
    """

    def __init__(self, T_rig_optical: FloatArray, known: tuple[float, float] = (0.0, 0.0)) -> None:
        self._T_rig_optical = T_rig_optical
        self._frame_pairs: deque[_FramePair] = deque(maxlen=_APART + 2)
        self._evidence: deque[tuple[float, float]] = deque(maxlen=_MAX_FRAME_PAIRS)
        self._known = known
        self._readout_s, self._sigma_s = known
        self._seen_s = 0.0, 0.0
        self._frames = 0

    @property
    def readout_s(self) -> float:
        """Time from the first row to the last, s, negative from the last to the first; 0 where it may be chance."""
        return self._readout_s

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the readout, s; 0 while nothing is known."""
        return self._sigma_s

    @property
    def seen_s(self) -> tuple[float, float]:
        """Readout as the frames alone show it, certain or not, and its standard error, s; zeros for too few frames."""
        return self._seen_s

    def corrected(self, frame: Frame, dt: float, T_previous_now: FloatArray | None = None) -> Frame:
        """The frame, dt (s) after the last, with its features where the middle row's instant has them.

        ``T_previous_now`` (4, 4) is the motion that led to it, None while that is not known.
        """
        readout = self.readout_s
        if readout == 0.0 or frame.cameras:
            return frame
        velocities = [] if T_previous_now is None else [velocity_of_motion(T_previous_now, dt)]
        if self._frame_pairs and self._follows(frame, dt):
            velocities += [m.velocity for m in reversed(self._frame_pairs)]
        if not velocities:
            return frame
        newest = np.array(velocities[: len(_SMOOTHING)])
        weights = _SMOOTHING if len(newest) == len(_SMOOTHING) else np.full(len(newest), 1.0 / len(newest))
        return replace(frame, z=self._moved(frame, weights @ newest, readout))

    def _follows(self, frame: Frame, dt: float) -> bool:
        return abs(1e-9 * (frame.stamp_ns - self._frame_pairs[-1].frame.stamp_ns) - dt) < 1e-6

    def learn(self, frame: Frame, ids: np.ndarray, columns: np.ndarray, T_previous_now: FloatArray, dt: float) -> None:
        """Take in a frame as it was measured, its landmarks ``ids`` at ``columns``, and its motion over dt (s)."""
        if frame.cameras:
            return
        if dt > _LONGEST_STEP_S or not (self._frame_pairs and self._follows(frame, dt)):
            self._frame_pairs.clear()
        self._frame_pairs.append(
            _FramePair(frame, ids, columns, T_previous_now, velocity_of_motion(T_previous_now, dt))
        )
        self._frames += 1
        if len(self._evidence) > _MIN_FRAME_PAIRS and self._frames % _FRAMES_PER_ESTIMATE:
            return
        for apart in range(len(self._frame_pairs) - 2, 0, -1):
            found = self._of_pair(apart)
            if found is not None:
                self._add(*found)
                return

    def _add(self, readout: float, sigma: float) -> None:
        """Take in the readout of one pair of frames and its standard deviation, s."""
        self._evidence.append((readout, np.hypot(sigma, _PAIR_SIGMA_S)))
        if len(self._evidence) >= _MIN_PAIRS:
            self._seen_s = _robust_mean(*np.array(self._evidence).T)
            mean, standard_error = self._with_known(*self._seen_s)
            # What was once beyond doubt is not given up for being a little less so: the map rests on it.
            least = _CERTAIN if self._readout_s == 0.0 else _DOUBTED
            self._readout_s = mean if abs(mean) > least * standard_error else 0.0
            self._sigma_s = standard_error

    def _with_known(self, mean: float, standard_error: float) -> tuple[float, float]:
        """Mean and standard error of what the frames show and of what was known beforehand."""
        known, sigma = self._known
        if sigma == 0.0:
            return mean, standard_error
        weights = np.array([standard_error, sigma]) ** -2.0
        return float(weights @ [mean, known] / weights.sum()), float(weights.sum() ** -0.5)

    # ---- one pair of frames
    def _of_pair(self, apart: int) -> tuple[float, float] | None:
        """Readout, s, and its standard deviation from the last moment but one and the one so many frames before it."""
        moments = list(self._frame_pairs)[-2 - apart :]
        first, second = moments[0], moments[-2]
        _, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
        if len(a) < _MIN_SHARED:
            return None
        before, now = first.frame.places(first.columns[a]), second.frame.places(second.columns[b])
        T = np.eye(4)
        for moment in moments[1:-1]:
            T = T @ moment.T_previous_now
        points, covariances = rig_points(before, self._T_rig_optical)
        candidates = Candidates(points, covariances, before.descriptors, before.tracks)
        motion = refine_motion(candidates, now, self._T_rig_optical, T, _GATE)
        if motion is None:
            return None
        rates = self._rates(before, _velocity(first, moments[1])) @ self._T_rig_optical[:3, :3].T
        later = replace(now, z=self._moved(now, _velocity(second, moments[-1]), _STEP_S))
        pairs = self._errors(candidates, now, motion.T)
        slope = (later.z - now.z) / _STEP_S + np.einsum("nij,nj->ni", pairs.J[:, :, :3], rates)
        return _solve(pairs, slope, np.maximum(motion.variance_scale, 1.0))

    def _errors(self, candidates: Candidates, frame: Frame, T: FloatArray) -> PairErrors:
        c, pairs = frame.camera, PairErrors.room(len(frame))
        pair_errors(
            candidates.points, candidates.covariances, frame.z, frame.variance, T @ self._T_rig_optical, T[:3, 3],
            np.array([c.fx, c.fy, c.cx, c.cy]), pairs.error, pairs.S, pairs.J, pairs.depth,
        )  # fmt: skip
        return pairs

    def _rates(self, frame: Frame, velocity: FloatArray) -> FloatArray:
        """By what (n, 3) m the points of a frame move in the optical frame per second of readout."""
        R, place = self._T_rig_optical[:3, :3], self._T_rig_optical[:3, 3]
        a, b = velocity[3:], place
        around = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        turn, shift = R.T @ a, R.T @ (velocity[:3] + around)
        rates = np.empty((len(frame), 3))
        rolling_rates(frame.z, frame.camera.lens, frame.camera.height, turn, shift, rates)
        return rates

    def _moved(self, frame: Frame, velocity: FloatArray, readout: float) -> FloatArray:
        """Measurements (n, 3) of the frame's points as the instant of the middle row has them."""
        moved = np.empty((len(frame), 3))
        moved_measurements(frame.z, frame.camera.lens, self._rates(frame, velocity), readout, moved)
        return moved


def _velocity(moment: _FramePair, after: _FramePair) -> FloatArray:
    """Velocity (6,) of the rig at a moment: the mean of the motions that led to it and away from it."""
    return np.asarray(0.5 * (moment.velocity + after.velocity))


def _solve(pairs: PairErrors, slope: FloatArray, variance_scale: FloatArray) -> tuple[float, float] | None:
    """Readout and its standard deviation with the motion beside it, by weights that far-off pairs lose (Huber 1964).

    ``slope`` (n, 3): what a second of readout adds to the errors.
    """
    x, N, gradient = np.zeros(7), np.empty((7, 7)), np.empty(7)
    for _ in range(3):
        readout_equations(pairs.error, pairs.S, pairs.J, slope, np.sqrt(variance_scale), x, _HUBER, N, gradient)
        try:
            covariance = np.linalg.inv(N)
        except np.linalg.LinAlgError:
            return None
        x = covariance @ gradient
    readout, variance = float(x[6]), float(covariance[6, 6])
    return (readout, np.sqrt(variance)) if abs(readout) < _LONGEST_READOUT_S and variance > 0.0 else None


def _robust_mean(values: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Mean of values (n,) weighted by their sigma, far-off ones bounded (Huber 1964), and its standard error.

    The latter is the sandwich estimate over groups of neighbours, which share frames (White 1980), and no less than
    what the sigma say: the few groups of a run's beginning may agree by chance.
    """
    mean, weight = float(np.median(values)), sigma**-2.0
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(values - mean) / sigma)), _LEAST_SCALE)
    for _ in range(5):
        pull = sigma * scale * np.clip((values - mean) / (sigma * scale), -_BOUND, _BOUND)
        inside = np.abs(values - mean) < _BOUND * sigma * scale
        mean += float(weight @ pull / (weight @ inside))
    groups = np.add.reduceat(weight * pull, np.arange(0, len(values), _GROUP))
    return mean, float(max(np.sqrt(groups @ groups) / (weight @ inside), 1.0 / np.sqrt(weight.sum())))
