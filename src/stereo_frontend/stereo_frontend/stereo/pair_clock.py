# SPDX-License-Identifier: Apache-2.0
"""``pair_clock``: learns by how much the right image is taken after the left one, and what that does to matches.

Two cameras without a common trigger look at different moments. While the rig moves, the partner of a keypoint then lies
off its place by the image's motion in between, across the rows, where every match shows it, and along them, where it
bends depth. So row differences are fitted by three things together: the time offset times the motion of the image, the
errors of the rectification, which stay as they are while the motion changes, and a right camera that stands farther
ahead, which looks like a time offset at constant speed. The camera's velocity is that of the tracked features.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass

import numpy as np

from slam_core.camera import StereoCamera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, Float32Array
from stereo_frontend.stereo.disparity import RefinedDisparity
from stereo_frontend.stereo.image_motion import REACH, PredictedVelocity, Step, central_velocity, right_flow
from stereo_frontend.stereo.normal_equations import (
    MEDIAN_CHI_SQUARE_1,
    EvidenceWindow,
    NormalEquations,
    robust_weights,
    sandwich_estimate,
)
from stereo_frontend.stereo.rectification_error import PRIOR_SIGMA, row_basis

_AHEAD_SIGMA = 0.01
"""By how much the right camera may stand ahead of the left one beforehand, in baselines."""
_SIGMAS = 5.0
"""An offset is believed beyond so many standard deviations."""
_LEAST_S = 5e-4
"""And from here on: less moves matches by less than their noise."""
_HYSTERESIS = 0.5
"""An offset stays until it falls below this share of what it took to be believed."""
_VELOCITY_ERROR = 0.03
"""Share by which velocities are wrong all alike: a walker's steps are quicker than ten frames a second show."""
_MUCH_PX = 3.0
"""Median shift along the rows from which what is left of it, a thirtieth on a walk, is like the noise of a match."""
_ANY_VELOCITY: FloatArray = np.diag([0.5, 0.5, 0.5, 0.5, 0.5, 0.5]) ** 2
"""Covariance of a velocity of which nothing is known, m/s and rad/s."""
_LEAST_FRAMES = 5
_MANY_FRAMES = 100
"""Frames of evidence from which on one in ``_GROUP`` is enough to notice a change."""
_LEAST_FLOW_PX = 10.0
"""Median motion of the image, px/s, below which a frame says nothing."""
_MIN_MATCHES = 30
_ROW_FLOOR = 0.1
"""Standard deviation of a perfect match's row difference, px."""
_ITERATIONS = 4
_GROUP, _PIECES = 4, 400
"""Frames that are not independent, and those that are remembered."""


@dataclass(frozen=True)
class PairClockConfig(Config):
    """Time between the two images of a pair, as far as it is known."""

    time_offset: float = parameter(
        0.0,
        "by how much the right image is taken after the left one of the same pair",
        unit="s",
        minimum=-0.1,
        maximum=0.1,
    )
    sigma_time_offset: float = parameter(
        0.02,
        "by how much time_offset may be wrong; 0: it is exact, nothing is learnt",
        unit="s",
        minimum=0.0,
        maximum=0.1,
    )


@dataclass(frozen=True, eq=False)
class Shift:
    """Motion of right pixels in the time between the images: (n, 2) px, with the standard deviation (n,) px along u."""

    uv: Float32Array
    sigma: FloatArray

    def without(self, seen: RefinedDisparity) -> RefinedDisparity:
        """Alignments as if both images had been taken together."""
        disparity, row_shift = seen.disparity + self.uv[:, 0], seen.row_shift - self.uv[:, 1]
        return dataclasses.replace(seen, disparity=disparity, row_shift=row_shift)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Row differences (n,) px of one frame, as measured, with their variance; where they were, and their disparity."""

    stereo: StereoCamera
    uv_right: FloatArray
    disparity: FloatArray
    row_shift: FloatArray
    variance: FloatArray


class PairClock:
    """Time of the right image after the left one: :attr:`time_offset` is used, :meth:`figures` tells what was learnt.

    For every frame first :meth:`move`, then any number of :meth:`shift`, then :meth:`learn`. Without ``tracks``, which
    tell the motion, a time offset is of no use: none is taken into account, and :meth:`advice` says so.
    """

    def __init__(self, config: PairClockConfig | None = None, *, tracks: bool = True) -> None:
        given = config or PairClockConfig()
        self._unused_s = 0.0 if tracks else given.time_offset
        self.config = given if tracks else PairClockConfig(time_offset=0.0, sigma_time_offset=0.0)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._estimate = (0.0, self.config.sigma_time_offset)
        self.is_believed = self._has_changed = False
        self._evidence = EvidenceWindow(_GROUP, _PIECES)
        self._prediction = PredictedVelocity()
        self._parameters: FloatArray = np.zeros(len(PRIOR_SIGMA) + 2)
        self._disparity, self._stamp_ns, self._turn = 0.0, -1, 0
        self._forget_motion()

    def _forget_motion(self) -> None:
        self._steps: deque[Step] = deque(maxlen=2 * REACH + 1)
        self._frames: deque[_Rows | None] = deque(maxlen=REACH)
        self._velocity: FloatArray | None = None
        self._moved_px = 0.0
        self._rows: _Rows | None = None

    # ---- what is known
    @property
    def learnt(self) -> tuple[float, float]:
        """The time offset as the images show it and its standard deviation, s."""
        beyond, sigma = self._estimate
        offset = self.config.time_offset + beyond
        return offset, min(float(np.hypot(sigma, _VELOCITY_ERROR * offset)), self.config.sigma_time_offset)

    @property
    def time_offset(self) -> float:
        """The time offset that matches are corrected for, s."""
        beyond = self._estimate[0] if self.is_believed or self.config.time_offset != 0.0 else 0.0
        return self.config.time_offset + beyond

    def shift(self, stereo: StereoCamera, uv_right: AnyArray, disparity: AnyArray | None = None) -> Shift:
        """Motion of pixels (n, 2) of the right image between the images; at the usual disparity, or (n,) px.

        Nothing where no time offset is known; where the velocity is not known, a shift that may be far from none.
        """
        offset, n = self.time_offset, len(uv_right)
        if offset == 0.0:
            return Shift(np.zeros((n, 2), np.float32), np.zeros(n))
        J = right_flow(stereo, uv_right, np.full(n, self._disparity) if disparity is None else np.nan_to_num(disparity))
        velocity, covariance = self._velocity, self._prediction.covariance
        if velocity is None:
            velocity, covariance = np.zeros(6), _ANY_VELOCITY
        flow = J @ velocity
        of_velocity = np.einsum("ni,ij,nj->n", J[:, 0], covariance, J[:, 0])
        sigma = np.sqrt(offset**2 * of_velocity + (self.learnt[1] * flow[:, 0]) ** 2)
        self._moved_px = float(np.median(np.abs(offset * flow)[:, 0])) if n else 0.0
        return Shift((offset * flow).astype(np.float32), sigma)

    @property
    def finding(self) -> tuple[float, float]:
        """The time offset and its standard deviation, s; zeros where none is seen."""
        return self.learnt if self.is_believed else (0.0, 0.0)

    @property
    def diagnostic(self) -> str:
        """That matches of the newest frame have moved by more than is corrected well, or ""."""
        if self._moved_px < _MUCH_PX:
            return ""
        return (
            f"matches have moved by {self._moved_px:.1f} px in the {1e3 * self.time_offset:.1f} ms between the images"
        )

    def figures(self) -> dict[str, float | str]:
        """Figures for a summary; empty while nothing was learnt."""
        if len(self._evidence) < _LEAST_FRAMES:
            return {}
        offset, sigma = self.learnt
        return {"right_image_late_ms": 1e3 * offset, "right_image_late_sigma_ms": 1e3 * sigma}

    def advice(self) -> str:
        """Advice to the user, or ""."""
        if self._unused_s != 0.0:
            return (
                f"pair.time_offset, {1e3 * self._unused_s:.1f} ms, is left out: it needs the motion of features that "
                "are followed (features.tracking: always)"
            )
        (offset, sigma), known = self.learnt, self.config.time_offset
        if not self.is_believed or abs(offset - known) < max(_SIGMAS * sigma, _LEAST_S):
            return ""
        said = (
            f"the right image is taken {1e3 * abs(offset):.1f} +- {1e3 * sigma:.1f} ms "
            f"{'after' if offset > 0.0 else 'before'} the left one, corrected as far as the motion is smooth"
        )
        return said + (
            ": trigger both together, or slam calibrate refine"
            if known == 0.0
            else f"; pair.time_offset says {1e3 * known:.1f} ms: slam calibrate refine again"
        )

    # ---- one frame, in order
    def move(self, stamp_ns: int, T_now_before: FloatArray | None, dt: float) -> None:
        """Begin a frame: the camera's motion (4, 4) in the ``dt`` s since the one before, None if it is not known.

        What is said first of a frame counts.
        """
        if stamp_ns == self._stamp_ns or self._is_off:
            return
        self._stamp_ns, self._moved_px = stamp_ns, 0.0
        if T_now_before is None or not dt > 0.0:
            self._forget_motion()
            return
        self._frames.append(self._rows)
        self._steps.append(Step.between(T_now_before, dt))
        self._take_middle()
        self._rows = None
        self._velocity = self._prediction(list(self._steps))

    def learn(self, stereo: StereoCamera, uv: AnyArray, seen: RefinedDisparity, disparity: AnyArray) -> bool:
        """Take in what was seen of a frame: left pixels (n, 2), alignments as measured, corrected disparities (n,) px.

        True if the offset has become one to be corrected, or is one no longer, so that what was learnt of rows and
        disparities before was learnt of others.
        """
        if self._is_off:
            return False
        known = np.isfinite(disparity) & np.isfinite(seen.row_shift)
        if known.sum() >= _MIN_MATCHES:
            self._disparity = float(np.median(disparity[known]))
            right = uv - np.column_stack([seen.disparity, -seen.row_shift])
            variance = np.square(seen.row_sigma, dtype=np.float64) + _ROW_FLOOR**2
            values = (right, disparity, seen.row_shift, variance)
            self._rows = _Rows(stereo, *(np.asarray(value[known], np.float64) for value in values))
        has_changed, self._has_changed = self._has_changed, False
        return has_changed

    def _take_middle(self) -> None:
        """Evidence of the frame that has as many steps after it as before it."""
        steps = list(self._steps)
        if len(steps) < 2 * REACH:
            return
        rows = self._frames[0]
        before, after = steps[:-REACH], steps[-REACH:]
        velocity = central_velocity(before[-REACH:], after)
        self._prediction.learn(before, velocity)
        self._turn += 1
        is_left_out = len(self._evidence) >= _MANY_FRAMES and not self.is_believed and self._turn % _GROUP > 0
        if rows is None or is_left_out or self.config.sigma_time_offset == 0.0:
            return
        flow = right_flow(rows.stereo, rows.uv_right, rows.disparity)[:, 1] @ velocity
        if np.median(np.abs(flow)) >= _LEAST_FLOW_PX:
            self._evidence.add(self._equations(rows, flow))
            self._solve()

    def _equations(self, rows: _Rows, flow: FloatArray) -> NormalEquations:
        """Evidence of one frame, whose image moves by ``flow`` (n,) px/s across the rows; robust."""
        c = rows.stereo.camera
        xy = (rows.uv_right - [c.cx, c.cy]) / [c.fx, c.fy]
        static = row_basis(xy, rows.disparity / c.fx)
        J = np.column_stack([c.fx * static, xy[:, 1] * rows.disparity, flow])
        measured = rows.row_shift - self.config.time_offset * flow
        prior, theta = np.diag(1.0 / self._prior_sigma() ** 2), self._parameters
        for _ in range(_ITERATIONS):
            squares = (measured - J @ theta) ** 2 / rows.variance
            noise = max(1.0, float(np.median(squares)) / MEDIAN_CHI_SQUARE_1)
            weighted = J * robust_weights(squares, noise, rows.variance)[:, None]
            evidence = NormalEquations(J.T @ weighted, weighted.T @ measured)
            sums = evidence.information + prior, evidence.vector + prior @ self._parameters
            theta = np.asarray(np.linalg.solve(*sums))
        return evidence

    @property
    def _is_off(self) -> bool:
        """True if there is no offset to correct and none to learn."""
        return self.config.time_offset == 0.0 and self.config.sigma_time_offset == 0.0

    def _prior_sigma(self) -> FloatArray:
        return np.append(PRIOR_SIGMA, [_AHEAD_SIGMA, self.config.sigma_time_offset])

    def _solve(self) -> None:
        theta, covariance = sandwich_estimate(self._evidence.sums, np.diag(1.0 / self._prior_sigma() ** 2))
        self._parameters = theta
        self._estimate = float(theta[-1]), float(np.sqrt(covariance[-1, -1]))
        slack = _HYSTERESIS if self.is_believed else 1.0
        enough = len(self._evidence) >= _LEAST_FRAMES
        offset, sigma = self.learnt
        is_believed = enough and abs(offset) > slack * max(_SIGMAS * sigma, _LEAST_S)
        self._has_changed = self._has_changed or (is_believed != self.is_believed and self.config.time_offset == 0.0)
        self.is_believed = is_believed
