# SPDX-License-Identifier: Apache-2.0
"""The pictures of a run: the map from above, errors and standard deviations over time, time per frame."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from dense_mapping.plans.floor_plan import FREE, OCCUPIED, FloorPlan
from dense_mapping.plans.navigation import frontiers
from slam_core.estimation.chi_square import ELLIPSE_PROBABILITY, chi_square_bound
from slam_core.evaluation import align, associate
from slam_core.geometry import FloatArray, boxminus, invert_transform
from slam_core.plural import plural
from slam_core.storage.files import atomic_path
from slam_viewer.report.canvas import blank, draw_to_scale
from slam_viewer.results import AgentResult, RunResult

matplotlib.use("Agg")
matplotlib.rcParams["text.parse_math"] = False  # names come from recordings: a dollar sign in one begins no formula
matplotlib.rcParams["axes.titley"] = 1.0  # else titles look for what they might touch: a sixth of the time to draw

COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd")
_TRUTH = "#222222"


def save_png(path: Path, figure: Figure, dpi: int = 130) -> None:
    """Write a figure."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(png(figure, dpi))


def png(figure: Figure, dpi: int) -> bytes:
    """A figure as PNG, without a date, so that equal figures are equal bytes.

    Packed quickly: a tenth larger than packed well, which takes a quarter of the time for drawing.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None}, pil_kwargs={"compress_level": 1})
    return buffer.getvalue()


def map_figure(result: RunResult) -> Figure:
    """The map from above: dense points, landmarks with 99.5 % ellipses, trajectories, ground truth (Fig. 9.2)."""
    figure, ((axes,),) = blank(6.0)
    _draw_dense(axes, result)
    _draw_landmarks(axes, result)
    for agent, colour in zip(result.agents, COLOURS * len(result.agents), strict=False):
        _draw_agent(axes, agent, colour)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(
        f"{plural(len(result.landmarks.positions), 'landmark')} (99.5 % ellipses), "
        f"{plural(result.submaps, 'submap')}, {plural(result.loop_closures, 'loop closure')}"
    )
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    named = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))  # ground truth of several agents: once
    if named:
        axes.legend(named.values(), named.keys(), loc="upper right", framealpha=0.9)
    _limit_to_content(axes, result)
    draw_to_scale(figure, axes)
    return figure


def _draw_dense(axes: Axes, result: RunResult) -> None:
    if len(result.dense):
        low, high = np.percentile(result.dense.points[:, 2], [1, 99])
        # Floor and ceiling hide everything from above: leave out the highest and lowest slices of the room.
        keep = (result.dense.points[:, 2] > low + 0.15) & (result.dense.points[:, 2] < high - 0.15)
        x, y, _ = result.dense.points[keep].T
        axes.scatter(x, y, s=0.3, c="0.78", linewidths=0, rasterized=True)


def _draw_landmarks(axes: Axes, result: RunResult) -> None:
    landmarks = result.landmarks
    if len(landmarks.positions) == 0:
        return
    values, vectors = np.linalg.eigh(landmarks.covariances[:, :2, :2])
    axis_lengths = 2.0 * np.sqrt(np.maximum(values, 0.0) * chi_square_bound(ELLIPSE_PROBABILITY, 2))
    # An ellipse as large as a room says only that the landmark is far away.
    shown = axis_lengths[:, 1] < 2.0
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            axis_lengths[shown, 1],
            axis_lengths[shown, 0],
            angle[shown],
            units="xy",
            offsets=landmarks.positions[shown, :2],
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors="#e69f00",
            linewidths=0.5,
            alpha=0.6,
        )
    )
    axes.scatter(landmarks.positions[:, 0], landmarks.positions[:, 1], s=3, c="#b36b00", label="landmarks", zorder=3)


def _draw_agent(axes: Axes, agent: AgentResult, colour: str) -> None:
    if not len(agent.trajectory):
        return
    xy = agent.trajectory.poses[:, :2, 3]
    axes.plot(*xy.T, color=colour, linewidth=2.4, label=agent.name or "trajectory", zorder=5)
    axes.plot(*xy[0], "o", color=colour, markersize=6, zorder=6)
    axes.plot(*xy[-1], "s", color=colour, markersize=6, zorder=6)
    pair = matched_poses(agent)
    if pair is not None:
        truth = pair[1]
        axes.plot(
            truth[:, 0, 3],
            truth[:, 1, 3],
            linestyle=(0, (6, 6)),
            color=_TRUTH,
            linewidth=0.9,
            label="ground truth",
            zorder=5.5,
        )


def _limit_to_content(axes: Axes, result: RunResult) -> None:
    points = [agent.trajectory.poses[:, :2, 3] for agent in result.agents if len(agent.trajectory)]
    if not points:
        return
    path = np.concatenate(points)
    near = result.landmarks.positions[:, :2]
    if len(near):
        low, high = np.percentile(near, [2, 98], axis=0)
        path = np.concatenate([path, [low, high]])
    margin = 0.5
    axes.set_xlim(path[:, 0].min() - margin, path[:, 0].max() + margin)
    axes.set_ylim(path[:, 1].min() - margin, path[:, 1].max() + margin)


def floor_plan_figure(result: RunResult, plan: FloorPlan) -> Figure:
    """A storey from above with the trajectories, and where nobody has looked yet (frontiers); origin as in the map."""
    figure, ((axes,),) = blank(6.0)
    rows, columns = plan.cells.shape
    shades = np.select([plan.cells == FREE, plan.cells == OCCUPIED], [255, 30], 200).astype(np.uint8)
    T_plan_map = invert_transform(plan.T_map_plan)
    x0, y0, _ = T_plan_map[:3, 3]
    extent = (-x0, columns * plan.resolution - x0, -y0, rows * plan.resolution - y0)
    axes.imshow(shades, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    for agent, colour in zip(result.agents, COLOURS * len(result.agents), strict=False):
        if len(agent.trajectory):
            path = agent.trajectory.poses[:, :3, 3] @ T_plan_map[:3, :3].T
            axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.4, label=agent.name or "trajectory")
    borders = [f.point for f in frontiers(plan)]
    if borders:
        x, y, _ = T_plan_map[:3, :3] @ np.stack(borders).T
        axes.scatter(x, y, s=22, c=COLOURS[0], marker="o", label="not yet seen behind", zorder=4)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(f"{plan.free_m2:.1f} m² seen free, cells of {100 * plan.resolution:.0f} cm")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", framealpha=0.9)
    return figure


def matched_poses(agent: AgentResult, alignment: str = "se3") -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Times (n,) s, true poses in the map frame (n, 4, 4) and estimated poses (n, 4, 4); None without ground truth."""
    if len(agent.truth) < 2 or len(agent.trajectory) < 2:
        return None
    try:
        matched, truth = associate(agent.trajectory, agent.truth)
    except ValueError:
        return None
    return (
        (matched.stamps_ns - agent.trajectory.stamps_ns[0]) / 1e9,
        align(truth, matched.poses, alignment),
        matched.poses,
    )


def error_figure(agent: AgentResult) -> Figure | None:
    """Position and rotation error over time inside the 99.5 % bounds that the covariance states.

    The first poses are made to agree: the map's frame is its first pose.
    """
    pair = matched_poses(agent, "origin")
    if pair is None or agent.trajectory.covariances is None:
        return None
    times, truth, _ = pair
    matched, _ = associate(agent.trajectory, agent.truth)
    assert matched.covariances is not None
    error = boxminus(matched.poses, truth)
    error[:, 3:] = np.degrees(error[:, 3:])
    sigma = np.sqrt(np.diagonal(matched.covariances, axis1=1, axis2=2)).copy()
    sigma[:, 3:] = np.degrees(sigma[:, 3:])
    bound = float(np.sqrt(chi_square_bound(ELLIPSE_PROBABILITY, 1)))
    figure, grid = blank(4.2, 2, 3)
    for i, (axes, name) in enumerate(
        zip(grid.ravel(), ("x m", "y m", "z m", "rx deg", "ry deg", "rz deg"), strict=True)
    ):
        axes.fill_between(times, -bound * sigma[:, i], bound * sigma[:, i], color="0.88", label="99.5 % bound")
        axes.plot(times, error[:, i], color=COLOURS[0], linewidth=1.0, label="error")
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=8)
    grid[0, 0].legend(fontsize=7)
    figure.supxlabel("time [s]", fontsize=9)
    return figure


def timing_figure(result: RunResult) -> Figure:
    """Milliseconds of every stage over the run (thesis Fig. 9.20, time per sample)."""
    figure, ((axes,),) = blank(2.8)
    for name, times in result.stage_ms.items():
        if times:
            axes.plot(np.linspace(0, 1, len(times)), times, linewidth=0.9, label=f"{name} ({np.median(times):.1f} ms)")
    axes.set_xlabel("share of the run")
    axes.set_ylabel("ms per call")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")  # powers of ten as formulas load fonts and a parser
    axes.yaxis.set_minor_formatter(NullFormatter())
    if result.stage_ms:
        axes.legend(fontsize=8, ncols=3)
    axes.grid(color="0.92")
    return figure


def features_figure(agent: AgentResult) -> Figure | None:
    """Number of features with depth in each frame; None without frames."""
    if not len(agent.feature_counts):
        return None
    figure, ((axes,),) = blank(2.1)
    axes.plot(agent.feature_counts, color=COLOURS[1], linewidth=1.0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("frame")
    axes.set_ylabel("features")
    axes.grid(color="0.92")
    return figure
