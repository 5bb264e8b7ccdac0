# SPDX-License-Identifier: Apache-2.0
"""Figures of how the map hangs together: submaps before and after joining, and the sparsity of what is solved."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sjsam_node.smoothing.map_snapshot import MapSnapshot
from slam_core.geometry import FloatArray, transform_points
from slam_viewer.report.canvas import blank
from slam_viewer.report.figures import COLOURS

_MOST_ENTRIES = 200_000


def submaps_figure(snapshot: MapSnapshot) -> Figure | None:
    """Submaps and their landmarks from above, chained by odometry alone and joined, with the closures (Fig. 9.3)."""
    if len(snapshot) < 2:
        return None
    figure, ((before, after),) = blank(3.9, 1, 2, sharex=False)
    joined = snapshot.poses[snapshot.nodes[:, 0]]
    for axes, starts, title in (
        (before, _chained(snapshot), "before: by odometry alone"),
        (after, joined, "after joining"),
    ):
        _draw_submaps(axes, snapshot, starts)
        axes.set_title(title, fontsize=10)
    for ends in snapshot.closure_lines()[:, :, :2]:
        after.plot(*ends.T, color="#d4a000", linewidth=1.0)
    return figure


def _chained(snapshot: MapSnapshot) -> FloatArray:
    """Starts (n, 4, 4) of the submaps where each begins at the end of the one before, as its agent's filter has it."""
    ends: dict[int, FloatArray] = {}
    starts = []
    for submap, (first, last) in zip(snapshot.submaps, snapshot.nodes.tolist(), strict=True):
        start = ends.get(first, snapshot.poses[first])
        starts.append(start)
        ends[last] = start @ submap.end_pose
    return np.stack(starts)


def _draw_submaps(axes: Axes, snapshot: MapSnapshot, starts: FloatArray) -> None:
    every = list(zip(snapshot.submaps, starts, strict=True))
    own = ~snapshot.is_position
    for k, (submap, T) in enumerate(every[i] for i in np.nonzero(own)[0].tolist()):
        colour = COLOURS[k % len(COLOURS)]
        points = transform_points(T, submap.landmarks)
        axes.plot(points[:, 0], points[:, 1], ".", color=colour, markersize=1.5, alpha=0.5)
        path = np.array([(T @ pose.T)[:2, 3] for pose in submap.path])
        axes.plot(*path.T, color=colour, linewidth=1.6)
    middle = starts[own, :2, 3]
    margin = 0.3 * float(np.ptp(middle, axis=0).max()) + 2.0
    axes.set_xlim(middle[:, 0].min() - margin, middle[:, 0].max() + margin)
    axes.set_ylim(middle[:, 1].min() - margin, middle[:, 1].max() + margin)
    axes.set_aspect("equal", adjustable="box")
    axes.grid(color="0.92")
    axes.set(xlabel="x [m]", ylabel="y [m]")


def sparsity_figure(snapshot: MapSnapshot) -> Figure | None:
    """Figure of the measurements (rows) and the unknowns (columns) they depend on, Fig. 7.1: poses, then landmarks."""
    if len(snapshot) < 2:
        return None
    rows, columns = _entries(snapshot)
    unknowns = len(snapshot.poses) + len(np.unique(columns[columns >= len(snapshot.poses)]))
    figure, ((axes,),) = blank(3.6)
    shown = slice(None, None, 1 + len(rows) // _MOST_ENTRIES)
    axes.plot(columns[shown], rows[shown], ".", color=COLOURS[1], markersize=1.2, rasterized=True)
    axes.axvline(len(snapshot.poses) - 0.5, color="0.6", linewidth=0.8)
    axes.invert_yaxis()
    filled = len(rows) / max((rows.max() + 1) * unknowns, 1)
    axes.set_title(f"{rows.max() + 1} measurements of {unknowns} unknowns, {filled:.2%} filled", fontsize=10)
    axes.set(xlabel=f"unknowns: {len(snapshot.poses)} poses, then landmarks", ylabel="measurements by submap")
    return figure


def _entries(snapshot: MapSnapshot) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the blocks of A that are not zero: ends of submaps, and landmarks that submaps share."""
    shared, nodes = snapshot.is_shared, snapshot.nodes.tolist()
    _, column_of = np.unique(snapshot.landmark_of[shared], return_inverse=True)
    landmark = np.full(len(snapshot.landmark_of), -1)
    landmark[shared] = len(snapshot.poses) + column_of
    rows: list[int] = []
    columns: list[int] = []
    row = 0
    seen = np.split(landmark, np.cumsum([len(submap.landmarks) for submap in snapshot.submaps])[:-1])
    for (start, end), own in zip(nodes, seen, strict=True):
        rows += [row, row]
        columns += [start, end]
        row += 1
        for column in own:
            if column >= 0:
                rows += [row, row]
                columns += [start, int(column)]
                row += 1
    return np.array(rows), np.array(columns)
