# SPDX-License-Identifier: Apache-2.0
"""Velocity of a camera at its frames from the motions between them, and how pixels of the right image move by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.camera import StereoCamera
from slam_core.geometry import FloatArray, so3_left_jacobian_inverse, so3_log
from slam_core.types import AnyArray

REACH = 3
"""Steps before and after a frame that its velocity is taken from: steps of a walker have up to two periods a second."""
_SMOOTHING = 0.9
"""Weight of the past in the covariance of predicted velocities."""
_CHANGES = 3
"""Changes of the velocity before a frame that its prediction may use."""
_FORGETTING, _RIDGE = 0.99, 0.3
"""Weight of the past in their weights; how much these are drawn towards none."""
_EVEN = 1.2
"""Most ratio of the lengths of two steps that are taken to be of one length."""
_FIRST_SIGMA: FloatArray = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
"""Standard deviation of a predicted velocity before any was compared, m/s and rad/s."""

_MEAN, _LINE, _WEIGHTS = _WAYS = ("mean of the last step", "line", "line and weights")
"""Ways to predict a velocity."""
_LEAST_DT_S = 1e-3


@dataclass(frozen=True, eq=False)
class Step:
    """Motion between two frames: their time apart, s, and the increment (6,) of translation m and rotation rad."""

    dt: float
    increment: FloatArray

    @classmethod
    def between(cls, T_now_before: FloatArray, dt: float) -> Step:
        """Step of a motion (4, 4) at constant velocity."""
        turn = so3_log(T_now_before[:3, :3])
        return cls(dt, np.concatenate([so3_left_jacobian_inverse(turn) @ T_now_before[:3, 3], turn]))

    @property
    def velocity(self) -> FloatArray:
        """Mean velocity (6,) of a still point in the camera's frame, m/s and rad/s."""
        return self.increment / self.dt


def central_velocity(before: list[Step], after: list[Step]) -> FloatArray:
    """Velocity (6,) at the frame between the steps: derivative of the polynomial through all frames' positions."""
    times = np.concatenate([-np.cumsum([s.dt for s in before[::-1]])[::-1], [0.0], np.cumsum([s.dt for s in after])])
    increments = np.array([s.increment for s in (*before, *after)])
    places = np.concatenate([np.zeros((1, 6)), np.cumsum(increments, axis=0)])
    scale = float(times[-1] - times[0])
    powers = np.vander(times / scale, increasing=True)
    return np.asarray(np.linalg.solve(powers, places)[1] / scale)


class PredictedVelocity:
    """Predicts the velocity at the newest frame from the steps before it, and learns how well.

    Beyond linear extrapolation each axis has three weights of the last changes of the velocity, by least squares: a
    walker's steps come back again and again. After one step its mean velocity is all there is, after two the line; each
    of these ways has a covariance of its own, learnt from all frames. ``covariance`` (6, 6) is that of the newest one.
    """

    def __init__(self) -> None:
        self._covariances = dict.fromkeys(_WAYS, np.diag(_FIRST_SIGMA**2))
        self.covariance: FloatArray = self._covariances[_LINE]
        self._usual_dt = 0.0
        self._information: FloatArray = np.zeros((6, _CHANGES, _CHANGES))
        self._vector: FloatArray = np.zeros((6, _CHANGES))

    def __call__(self, steps: list[Step]) -> FloatArray:
        """Velocity (6,) after the last step."""
        predictions = self._predictions(steps)
        way = next(reversed(predictions))
        self.covariance = self._covariances[way]
        if _is_uneven(steps):
            # The line through steps of other lengths was never compared: no better than the mean of the longest step.
            longest = max(s.dt for s in steps[-_CHANGES - 1 :])
            self.covariance = self._covariances[_MEAN] * max(1.0, longest / max(self._usual_dt, _LEAST_DT_S)) ** 2
        return predictions[way]

    def learn(self, steps: list[Step], velocity: FloatArray) -> None:
        """Compare predictions after the last step, by each way, with what was the velocity (6,)."""
        linear, changes = _extrapolated(steps)
        if not _is_uneven(steps):
            self._usual_dt = steps[-1].dt
            for way, predicted in self._predictions(steps).items():
                error = predicted - velocity
                new = (1.0 - _SMOOTHING) * np.outer(error, error)
                self._covariances[way] = _SMOOTHING * self._covariances[way] + new
        if changes is not None:
            self._information = _FORGETTING * self._information + np.einsum("ia,ja->aij", changes, changes)
            self._vector = _FORGETTING * self._vector + ((velocity - linear) * changes).T

    def _predictions(self, steps: list[Step]) -> dict[str, FloatArray]:
        """Velocity (6,) after the last step by each way that the steps allow, the best one last."""
        linear, changes = _extrapolated(steps)
        found = {_MEAN: steps[-1].velocity}
        if len(steps) > 1:
            found[_LINE] = linear
        if changes is not None:
            found[_WEIGHTS] = linear + np.einsum("ai,ia->a", self._weights(), changes)
        return found

    def _weights(self) -> FloatArray:
        """Weights (6, 3); drawn towards none by the evidence of some frames."""
        energy = np.einsum("aii->a", self._information) / _CHANGES
        ridge = _RIDGE * energy + np.finfo(np.float64).tiny
        return np.asarray(
            np.linalg.solve(self._information + ridge[:, None, None] * np.eye(_CHANGES), self._vector[:, :, None])[
                ..., 0
            ]
        )


def _is_uneven(steps: list[Step]) -> bool:
    lengths = [s.dt for s in steps[-_CHANGES - 1 :]]
    return max(lengths) >= _EVEN * min(lengths)


def _extrapolated(steps: list[Step]) -> tuple[FloatArray, FloatArray | None]:
    """Linear extrapolation (6,) of the velocity to the end of the last step, and its last changes (3, 6).

    No changes where there are too few steps, or not of one length.
    """
    if len(steps) < 2:
        return steps[-1].velocity, None
    velocities = np.array([s.velocity for s in steps[: -_CHANGES - 2 : -1]])
    last, before = steps[-1].dt, steps[-2].dt
    linear = velocities[0] + last / (last + before) * (velocities[0] - velocities[1])
    is_enough = len(velocities) == _CHANGES + 1 and not _is_uneven(steps)
    return linear, velocities[:-1] - velocities[1:] if is_enough else None


def right_flow(stereo: StereoCamera, uv_right: AnyArray, disparity: AnyArray) -> FloatArray:
    """Derivative (n, 2, 6) of the motion of pixels (n, 2) of the right image, px/s, by the camera's velocity (6,).

    ``disparity`` (n,) px tells how far their points are; the velocity is that of the left optical frame.
    """
    c = stereo.camera
    x, y = ((np.asarray(uv_right, np.float64) - [c.cx, c.cy]) / [c.fx, c.fy]).T
    inverse = np.maximum(np.asarray(disparity, np.float64), 0.0) / (c.fx * stereo.baseline)
    # The left frame's origin is a baseline to the left: a turn moves the right camera, too.
    near, zero = stereo.baseline * inverse, np.zeros_like(x)
    X = x + near
    u = np.column_stack([inverse, zero, -x * inverse, -x * y, 1.0 + x * X, -y])
    v = np.column_stack([zero, inverse, -y * inverse, -1.0 - y * y, y * X, X])
    return np.stack([c.fx * u, c.fy * v], axis=1)
