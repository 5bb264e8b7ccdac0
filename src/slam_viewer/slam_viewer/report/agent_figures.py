# SPDX-License-Identifier: Apache-2.0
"""Figures of one agent that need no ground truth: side view, standard deviations, angles and velocities, in time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from slam_core.geometry import FloatArray
from slam_viewer.report.canvas import blank, draw_to_scale
from slam_viewer.report.figures import COLOURS
from slam_viewer.results import AgentResult, RunResult

_AXES = ("x", "y", "z")


def side_view(result: RunResult) -> Figure | None:
    """Landmarks and paths from the side, height over the longer direction; None for a run without a path."""
    paths = [agent.trajectory.poses[:, :3, 3] for agent in result.agents if len(agent.trajectory) > 1]
    if not paths:
        return None
    path = np.concatenate(paths)
    along = int(np.argmax(np.ptp(path[:, :2], axis=0)))
    figure, ((axes,),) = blank(3.0)
    axes.grid(color="0.92")
    points = result.landmarks.positions
    if len(points):
        low, high = np.percentile(points, [2, 98], axis=0)
        axes.plot(points[:, along], points[:, 2], ".", color="#b36b00", markersize=2, label="landmarks")
        axes.set_xlim(min(low[along], path[:, along].min()) - 0.5, max(high[along], path[:, along].max()) + 0.5)
        axes.set_ylim(min(low[2], path[:, 2].min()) - 0.3, max(high[2], path[:, 2].max()) + 0.3)
    for agent, colour in zip(result.agents, COLOURS * len(result.agents), strict=False):
        positions = agent.trajectory.poses[:, :3, 3]
        axes.plot(positions[:, along], positions[:, 2], color=colour, linewidth=1.4, label=agent.name or "trajectory")
    draw_to_scale(figure, axes)
    axes.set(xlabel=f"{_AXES[along]} [m]", ylabel="z [m]")
    axes.legend(fontsize=8, loc="upper right")
    return figure


def sigma_figure(agent: AgentResult) -> Figure | None:
    """Standard deviations that the joined map claims; None without covariances."""
    covariances = agent.trajectory.covariances
    if covariances is None or len(agent.trajectory) < 2:
        return None
    sigma = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    figure, ((position, rotation),) = blank(2.6, 1, 2)
    for k, name in enumerate(_AXES):
        position.plot(_seconds(agent), 1e3 * sigma[:, k], linewidth=1.0, label=name)
        rotation.plot(_seconds(agent), np.degrees(sigma[:, 3 + k]), linewidth=1.0, label=f"about {name}")
    _finish(position, "standard deviation [mm]")
    _finish(rotation, "standard deviation [deg]")
    return figure


def motion_figure(agent: AgentResult) -> Figure | None:
    """Yaw, pitch and roll, and speed and turn rate; None for fewer than three poses."""
    if len(agent.trajectory) < 3:
        return None
    poses, time = agent.trajectory.poses, _seconds(agent)
    angles = np.unwrap(Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX"), axis=0)
    figure, ((attitude, speed),) = blank(2.6, 1, 2)
    for k, name in enumerate(("yaw", "pitch", "roll")):
        attitude.plot(time, np.degrees(angles[:, k]), linewidth=1.0, label=name)
    velocity = np.linalg.norm(np.gradient(poses[:, :3, 3], time, axis=0), axis=1)
    speed.plot(time, velocity, linewidth=1.0, label="speed [m/s]")
    speed.plot(time, _turn_rate(poses, time), linewidth=1.0, label="turn rate [rad/s]")
    _finish(attitude, "angle [deg]")
    _finish(speed, "")
    return figure


def _turn_rate(poses: FloatArray, time: FloatArray) -> FloatArray:
    """Rate of rotation (n,) rad/s between neighbouring poses (n, 4, 4)."""
    step = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]).magnitude()
    rate = step / np.maximum(np.diff(time), 1e-9)
    return np.append(rate, rate[-1])


def _seconds(agent: AgentResult) -> FloatArray:
    stamps = agent.trajectory.stamps_ns
    return np.asarray((stamps - stamps[0]) / 1e9, dtype=np.float64)


def _finish(axes: Axes, ylabel: str) -> None:
    axes.set(xlabel="time since start [s]", ylabel=ylabel)
    axes.grid(color="0.92")
    axes.legend(fontsize=8)
