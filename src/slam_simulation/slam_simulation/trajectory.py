# SPDX-License-Identifier: Apache-2.0
"""Motion of the rig: a smooth path through way points, and what a walking person adds to it.

Position, heading and pitch are cubic splines of time with zero velocity at both ends (twice continuously
differentiable). A motion style adds bob and sway at the step frequency and slow unrest, faded in and out so that a
loop returns to its start exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from slam_core.geometry import FloatArray, make_transform, rotation_from_euler, so3_log


@dataclass(frozen=True)
class MotionStyle:
    """Motion on top of the path: step frequency Hz, bob and sway m, nod and roll deg, unrest m and deg."""

    step_hz: float = 0.0
    bob: float = 0.0
    sway: float = 0.0
    nod_deg: float = 0.0
    roll_deg: float = 0.0
    unrest: float = 0.0
    unrest_deg: float = 0.0


MOTION_STYLES = {
    "tripod": MotionStyle(),
    "rig": MotionStyle(unrest=0.001, unrest_deg=0.1),
    "handheld": MotionStyle(1.7, 0.018, 0.02, 0.6, 0.8, 0.015, 1.8),
    "helmet": MotionStyle(1.9, 0.025, 0.03, 1.2, 1.2, 0.01, 2.5),
}
FADE_S = 1.0
UNREST_WAVES = 5
TURN_COST = 0.8
"""One radian of turning takes as long as this many metres."""
SWITCH_EARLY = 0.02
"""A tripod is moved this share of its stay before the next stay's first frame, so that it stands when that is taken."""


class Path(Protocol):
    """A motion over ``duration`` seconds."""

    @property
    def duration(self) -> float:
        """Time from the first to the last pose, s."""
        ...

    def pose(self, t: float) -> FloatArray:
        """``T_world_rig`` at time ``t`` s."""
        ...


class SplinePath:
    """A path through way points, rows (x, y, z, yaw, pitch) in m and rad, yaw unwrapped; shape (n, 5)."""

    def __init__(self, waypoints: FloatArray, duration: float, style: MotionStyle, rng: np.random.Generator) -> None:
        self._duration, self.style = duration, style
        knots = np.concatenate([[0.0], np.cumsum(path_cost(waypoints))])
        self._spline = CubicSpline(knots * (duration / knots[-1]), waypoints, bc_type="clamped")
        self._frequencies = rng.uniform(0.15, 1.1, (UNREST_WAVES, 6))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, (UNREST_WAVES, 6))
        self._step_phase = rng.uniform(0.0, 2.0 * np.pi)

    @property
    def duration(self) -> float:
        """Time from the first to the last pose, s."""
        return self._duration

    def pose(self, t: float) -> FloatArray:
        """``T_world_rig`` at time ``t``; the path stands still before its start and after its end."""
        t = float(np.clip(t, 0.0, self._duration))
        x, y, z, yaw, pitch = self._spline(t)
        T = make_transform(rotation_from_euler(yaw, pitch), np.array([x, y, z]))
        extra = self._fade(t) * self._extra(t)
        return np.asarray(T @ make_transform(rotation_from_euler(*extra[3:]), extra[:3]))

    def _fade(self, t: float) -> float:
        """Smooth 0 to 1 over the first and the last second, with two continuous derivatives (Perlin 2002)."""
        s = min(max(min(t, self._duration - t) / FADE_S, 0.0), 1.0)
        return s**3 * (s * (6.0 * s - 15.0) + 10.0)

    def _extra(self, t: float) -> FloatArray:
        """Offset of the rig in its own frame: x, y, z (m), yaw, pitch, roll (rad)."""
        s = self.style
        waves = np.sin(2.0 * np.pi * self._frequencies * t + self._phases).sum(axis=0) / np.sqrt(UNREST_WAVES / 2.0)
        unrest = waves * np.array([s.unrest] * 3 + [np.radians(s.unrest_deg)] * 3) * 0.6
        # Two steps make one stride: the body falls with each step and leans with each stride.
        step = 2.0 * np.pi * s.step_hz * t + self._step_phase
        up, lean = np.sin(step), np.sin(step / 2.0)
        gait = [0.0, s.sway * lean, s.bob * up, 0.0, np.radians(s.nod_deg) * up, np.radians(s.roll_deg) * lean]
        return np.asarray(unrest + gait)


def path_cost(waypoints: FloatArray) -> FloatArray:
    """Length (n - 1,) of each way between way points (n, 5), m, with their turns; time is shared out by it."""
    steps = np.linalg.norm(np.diff(waypoints[:, :3], axis=0), axis=1)
    cost = steps + TURN_COST * np.abs(np.diff(waypoints[:, 3])) + TURN_COST * np.abs(np.diff(waypoints[:, 4]))
    return np.asarray(np.maximum(cost, 1e-3))


class StationPath:
    """A tripod that is put down at one pose after the other, ``dwell`` s each; rows as in :class:`SplinePath`."""

    def __init__(self, stations: FloatArray, dwell: float) -> None:
        self._stations, self._dwell = stations, dwell

    @property
    def duration(self) -> float:
        """Time from the first to the last pose, s."""
        return self._dwell * len(self._stations)

    def pose(self, t: float) -> FloatArray:
        """``T_world_rig`` at time ``t``."""
        k = int(np.clip(np.floor(t / self._dwell + SWITCH_EARLY), 0, len(self._stations) - 1))
        x, y, z, yaw, pitch = self._stations[k]
        return make_transform(rotation_from_euler(yaw, pitch), np.array([x, y, z]))


def rig_twist(path: Path, t: float, step: float = 1e-3) -> FloatArray:
    """Velocity (6,) of the rig along its own axes: m/s and rad/s."""
    before, after = path.pose(t - step), path.pose(t + step)
    R = path.pose(t)[:3, :3]
    velocity = R.T @ (after[:3, 3] - before[:3, 3]) / (2.0 * step)
    return np.concatenate([velocity, so3_log(before[:3, :3].T @ after[:3, :3]) / (2.0 * step)])


def resolve_waypoints(rows: list[list[float]], height: float) -> FloatArray:
    """Way points (n, 5) from rows (x, y[, yaw deg[, pitch deg[, z]]]); without a yaw the rig looks along its path.

    No turn between two way points is longer than half a circle: yaw is taken at the turn nearest to the one before.
    """
    n = len(rows)
    xy = np.array([row[:2] for row in rows], dtype=np.float64)
    out = np.zeros((n, 5))
    out[:, :2], out[:, 2] = xy, height
    tangent = np.empty_like(xy)
    tangent[1:-1] = xy[2:] - xy[:-2]
    tangent[0], tangent[-1] = xy[min(1, n - 1)] - xy[0], xy[-1] - xy[max(n - 2, 0)]
    for i, row in enumerate(rows):
        out[i, 3] = np.radians(row[2]) if len(row) > 2 else np.arctan2(tangent[i, 1], tangent[i, 0])
        if i > 0:
            out[i, 3] += 2 * np.pi * np.round((out[i - 1, 3] - out[i, 3]) / (2 * np.pi))
        out[i, 4] = np.radians(row[3]) if len(row) > 3 else 0.0
        out[i, 2] = row[4] if len(row) > 4 else height
    return out
