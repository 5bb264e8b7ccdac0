# SPDX-License-Identifier: Apache-2.0
"""Report of a calibration: tables as in the thesis (2.1-2.3), board poses, and reprojection residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from slam_calibration.bundle import BundleResult
from slam_calibration.lens import parameter_names
from slam_core.geometry import FloatArray, inverse_jacobian, invert_transform, so3_log, transform_points

COLOURS = ("#1f77b4", "#d62728", "#2ca02c")


def extrinsics_of(result: BundleResult, camera: int) -> tuple[FloatArray, FloatArray]:
    """``T_first_camera``, the place of a camera in the first one's optical frame, and its covariance (6, 6)."""
    T_camera_first = result.rig.cameras[camera].T
    start = result.rig.names.index(f"{camera}.x")
    J = inverse_jacobian(T_camera_first)
    covariance = result.covariance[start : start + 6, start : start + 6]
    return invert_transform(T_camera_first), np.asarray(J @ covariance @ J.T)


def camera_deviations(result: BundleResult, camera: int) -> dict[str, float]:
    """Standard deviation of each parameter of a camera by name."""
    names = parameter_names(result.rig.cameras[camera].lens)
    return {name: result.standard_deviation(f"{camera}.{name}") for name in names}


def summary(result: BundleResult, names: Sequence[str]) -> dict[str, Any]:
    """Every number of a calibration, for JSON: ``names`` are the cameras'."""
    cameras = {}
    for c, (name, state) in enumerate(zip(names, result.rig.cameras, strict=True)):
        values = dict(zip(parameter_names(state.lens), state.parameters.tolist(), strict=True))
        cameras[name] = {
            "lens": state.lens,
            "parameters": values,
            "standard_deviations": camera_deviations(result, c),
            "pictures": sum(len(view[c]) > 0 for view in result.views),
        }
    document: dict[str, Any] = {"rms_px": result.rms, "converged": result.converged, "cameras": cameras}
    for c in range(1, len(names)):
        T, covariance = extrinsics_of(result, c)
        document[f"T_{names[0]}_{names[c]}"] = T.tolist()
        document[f"T_{names[0]}_{names[c]}_standard_deviations"] = np.sqrt(np.diag(covariance)).tolist()
    return document


def tables(result: BundleResult, names: Sequence[str]) -> str:
    """Markdown: each camera's parameters, then the position of the others in the first, with standard deviations."""
    lines = [f"Reprojection error {result.rms:.3f} px rms. +- is one standard deviation.", ""]
    for c, (name, state) in enumerate(zip(names, result.rig.cameras, strict=True)):
        pictures = sum(len(view[c]) > 0 for view in result.views)
        lines += [f"## Camera {name}: {state.lens}, {state.width} x {state.height} px, {pictures} pictures", ""]
        lines += ["| parameter | estimate | +- |", "|---|---|---|"]
        deviations = camera_deviations(result, c)
        for (key, deviation), value in zip(deviations.items(), state.parameters, strict=True):
            digits = 3 if key[0] in "fc" else 6
            lines.append(f"| {key} | {value:.{digits}f} | {deviation:.{digits}f} |")
        lines.append("")
    for c in range(1, len(names)):
        lines += _extrinsics_table(result, c, names)
    return "\n".join(lines)


def _extrinsics_table(result: BundleResult, camera: int, names: Sequence[str]) -> list[str]:
    T, covariance = extrinsics_of(result, camera)
    deviations = np.sqrt(np.diag(covariance))
    values = [*(1e3 * T[:3, 3]), *so3_log(T[:3, :3])]
    scaled = [*(1e3 * deviations[:3]), *deviations[3:]]
    units = ["x [mm]", "y [mm]", "z [mm]", "rotation x [rad]", "rotation y [rad]", "rotation z [rad]"]
    rows = [f"| {u} | {v:.5f} | {d:.5f} |" for u, v, d in zip(units, values, scaled, strict=True)]
    title = f"## Position of camera {names[camera]} in the optical frame of {names[0]}"
    return [title, "", "| | estimate | +- |", "|---|---|---|", *rows, ""]


def residual_figure(result: BundleResult, names: Sequence[str]) -> Figure:
    """Per camera: residual vectors over the image, enlarged, and their scatter with the 3-sigma circle."""
    figure = Figure(figsize=(6 * len(names), 9), layout="constrained")
    axes = figure.subplots(2, len(names), squeeze=False)
    for c, name in enumerate(names):
        seen = [(k[c].pixels, r[c]) for k, r in zip(result.views, result.residuals, strict=True) if len(k[c])]
        pixels, residuals = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        state = result.rig.cameras[c]
        scale = _draw_field(axes[0, c], pixels, residuals, state.width, state.height)
        axes[0, c].set_title(f"{name}: residuals, {scale:.0f} times enlarged")
        _draw_scatter(axes[1, c], residuals)
    return figure


def _draw_field(axes: Axes, pixels: FloatArray, residuals: FloatArray, width: int, height: int) -> float:
    """Draw the vectors so that a typical one spans 2 % of the image; returns how many times they are enlarged."""
    typical = max(float(np.median(np.linalg.norm(residuals, axis=1))), 1e-6)
    scale = 0.02 * width / typical
    axes.quiver(*pixels.T, *residuals.T, angles="xy", scale_units="xy", scale=1.0 / scale, width=0.0015)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    return scale


def _draw_scatter(axes: Axes, residuals: FloatArray) -> None:
    axes.plot(*residuals.T, ".", markersize=2, color=COLOURS[0])
    sigma = float(np.sqrt(np.square(residuals).mean()))
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    axes.plot(3 * sigma * np.cos(angle), 3 * sigma * np.sin(angle), color=COLOURS[1], label=f"3 x {sigma:.3f} px")
    axes.set(aspect="equal", xlabel="u residual [px]", ylabel="v residual [px]")
    axes.legend(loc="upper right")


def board_poses_figure(result: BundleResult, board_points: FloatArray, names: Sequence[str]) -> Figure:
    """The rig and every pose of the board, as the thesis's Figure 2.9."""
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    low, high = board_points.min(axis=0), board_points.max(axis=0)
    outline = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    for index, (view, T) in enumerate(zip(result.views, result.rig.board_poses, strict=True)):
        if any(len(corners) for corners in view):
            corners = _rig_axes(transform_points(T, outline[[0, 1, 2, 3, 0]]))
            axes.plot(*corners.T, color="0.3", linewidth=0.8)
            axes.add_collection3d(Poly3DCollection([corners], alpha=0.1, facecolor="0.5"))
            axes.text(*corners.mean(axis=0), str(index + 1), fontsize=8)
    size = 0.3 * float(np.linalg.norm(high - low))
    for c, name in enumerate(names):
        _draw_camera(axes, result, c, name, size)
    axes.set(xlabel="forward [m]", ylabel="left [m]", zlabel="up [m]", aspect="equal")
    axes.legend(loc="upper left")
    return figure


def _draw_camera(axes: Any, result: BundleResult, c: int, name: str, size: float) -> None:
    state = result.rig.cameras[c]
    half = 0.5 * np.array([state.width / state.parameters[0], state.height / state.parameters[1]])
    pyramid = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
    frame = size * np.column_stack([pyramid, np.ones(5)])
    T_first_camera = invert_transform(state.T)
    line = np.concatenate([frame, *(np.array([np.zeros(3), corner]) for corner in frame[:4])])
    axes.plot(*_rig_axes(transform_points(T_first_camera, line)).T, color=COLOURS[c % len(COLOURS)], label=name)


def _rig_axes(points: FloatArray) -> FloatArray:
    """Optical axes (right, down, forward) to forward, left, up, which plots upright."""
    return np.column_stack([points[:, 2], -points[:, 0], -points[:, 1]])
