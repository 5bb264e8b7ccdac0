# SPDX-License-Identifier: Apache-2.0
"""Figures as the thesis draws them: maps from above and from the side, standard deviations, submaps, scans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam_core.geometry import FloatArray
from slam_experiments.experiments.chain import yaw

Arrays = Mapping[str, npt.NDArray[Any]]
ESTIMATE, TRUTH, LANDMARK = "#1f77b4", "#222222", "#e08214"


def new_figure(width: float = 8.0, height: float = 5.0) -> tuple[Figure, Axes]:
    """A figure with one plot."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    return figure, axes


def map_view(arrays: Arrays, axis: int = 1, agent: int = 0, kind: str = "joined") -> Figure:
    """Landmarks and trajectory from above (``axis`` 1) or from the side (2), as Figs. 9.2 and 9.3."""
    figure, axes = new_figure(7.0, 5.0 if axis == 1 else 2.8)
    poses, truth = arrays[f"{agent} {kind} poses"], arrays.get(f"{agent} {kind} truth")
    points = arrays["landmarks"]
    low, high = box_of(np.concatenate([points, poses[:, :3, 3]]))
    axes.plot(points[:, 0], points[:, axis], ".", color=LANDMARK, markersize=2, label="landmarks")
    if truth is not None:
        aligned = poses[0] @ np.linalg.inv(truth[0]) @ truth
        axes.plot(aligned[:, 0, 3], aligned[:, axis, 3], "--", color=TRUTH, linewidth=1, label="ground truth")
    axes.plot(poses[:, 0, 3], poses[:, axis, 3], color=ESTIMATE, linewidth=1.4, label="estimated trajectory")
    axes.set(xlim=(low[0], high[0]), ylim=(low[axis], high[axis]), xlabel="x [m]", ylabel="yz"[axis - 1] + " [m]")
    axes.set_aspect("equal", adjustable="box")
    axes.legend(fontsize=8, loc="upper right")
    return figure


def map_in_3d(arrays: Arrays, agent: int = 0) -> Figure:
    """Landmarks and trajectory in three dimensions (Fig. 9.4)."""
    figure = Figure(figsize=(7, 5.5), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    points, poses = arrays["landmarks"], arrays[f"{agent} joined poses"]
    low, high = box_of(np.concatenate([points, poses[:, :3, 3]]))
    inside = np.all((points >= low) & (points <= high), axis=1)
    axes.scatter(*points[inside].T, s=2, c=LANDMARK)
    axes.plot(*poses[:, :3, 3].T, color=ESTIMATE, linewidth=1.4)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect(high - low)
    return figure


def box_of(points: FloatArray, margin: float = 0.5) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) of a box about points (n, 3) that leaves out the farthest hundredth on every side."""
    low, high = np.percentile(points, [1, 99], axis=0)
    return low - margin, high + margin


def standard_deviations(arrays: Arrays, agent: int = 0, kind: str = "joined") -> Figure:
    """Standard deviations of position and heading over the run (Figs. 9.5, 9.8, 9.10, 9.16, 9.18, 9.24)."""
    figure, axes = new_figure(8.0, 3.0)
    sigma = np.sqrt(np.diagonal(arrays[f"{agent} {kind} covariances"], axis1=1, axis2=2))
    time = arrays[f"{agent} {kind} time"]
    for k, name in enumerate(("x [m]", "y [m]", "z [m]")):
        axes.plot(time, sigma[:, k], linewidth=1.0, label=name)
    axes.plot(time, sigma[:, 5], linewidth=1.0, color="0.2", label="heading [rad]")
    axes.set(xlabel="time [s]", ylabel="standard deviation")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, ncols=4)
    return figure


def angles(arrays: Arrays, agent: int = 0) -> tuple[Figure, Figure]:
    """Yaw, pitch and roll, and their rates (Figs. 9.13 and 9.14)."""
    poses, time = arrays[f"{agent} joined poses"], arrays[f"{agent} joined time"]
    pitch = -np.arcsin(np.clip(poses[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(poses[:, 2, 1], poses[:, 2, 2])
    curves = {"yaw": yaw(poses), "pitch": pitch, "roll": roll}
    pair = []
    for ylabel, rates in (("angle [rad]", False), ("angular velocity [rad/s]", True)):
        figure, axes = new_figure(8.0, 3.0)
        for name, curve in curves.items():
            axes.plot(time, np.gradient(curve, time) if rates else curve, linewidth=1.0, label=name)
        axes.set(xlabel="time [s]", ylabel=ylabel)
        axes.legend(fontsize=8)
        pair.append(figure)
    return pair[0], pair[1]


def submaps(arrays: Arrays, kind: str) -> Figure:
    """Landmarks of every submap in a colour of its own: ``chained`` end to end, or ``joined`` (Figs. 9.19 to 9.27)."""
    figure, axes = new_figure(7.0, 5.0)
    points = arrays[kind]
    low, high = box_of(points)
    axes.scatter(points[:, 0], points[:, 1], c=arrays["submap_of"] % 20, cmap="tab20", s=2, linewidths=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="box")
    return figure


def measurement_matrix(arrays: Arrays) -> Figure:
    """Matrix of submaps (rows) that observe landmarks (columns), in the order of first sighting (Fig. 9.23)."""
    figure, axes = new_figure(8.0, 3.5)
    _, column = np.unique(arrays["landmark_of"], return_inverse=True)
    axes.plot(column, arrays["submap_of"], ",", color="black")
    axes.set(xlabel="landmark", ylabel="submap")
    axes.invert_yaxis()
    return figure


def times(arrays: Arrays, stage: str) -> Figure:
    """Milliseconds of every call of a stage (Figs. 9.20 and 9.25)."""
    figure, axes = new_figure(8.0, 2.6)
    axes.plot(arrays[f"ms {stage}"], linewidth=0.8)
    axes.set(xlabel="call", ylabel="ms")
    axes.set_ylim(bottom=0.0)
    return figure


def registrations(errors: FloatArray, title: str) -> Figure:
    """Translations and rotations found for each scan (Figs. 10.1 to 10.16); ``errors`` (n, 6): pose tangent found."""
    figure = Figure(figsize=(8, 2.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    scan = np.arange(1, len(errors) + 1)
    for axes, columns, names, unit in (
        (left, errors[:, :3], ("x", "y", "z"), "translation [m]"),
        (right, np.degrees(errors[:, 3:]), ("about x", "about y", "about z"), "rotation [deg]"),
    ):
        for k, name in enumerate(names):
            axes.plot(scan, columns[:, k], "o-", markersize=3, linewidth=0.8, label=name)
        axes.set(xlabel="scan", ylabel=unit)
        axes.grid(color="0.92")
        axes.legend(fontsize=7)
    figure.suptitle(title, fontsize=9)
    return figure
