# SPDX-License-Identifier: Apache-2.0
"""Output of ``slam plane``: summary, paths with covariances, landmarks and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from slam_experiments.planar.log import PlanarLog
from slam_experiments.planar.mapping import PlanarResult, accuracy, dead_reckoning
from slam_viewer.report.figures import COLOURS, save_png


def summarise(log: PlanarLog, result: PlanarResult, method: str, association: str) -> dict[str, Any]:
    """The content of ``summary.json``; m, deg and seconds of processor time."""
    robots = {}
    for robot, path in zip(log.robots, result.paths, strict=True):
        found: dict[str, float] = {"steps": len(robot.observations), **accuracy(robot, path)}
        if robot.truth is not None:
            error = dead_reckoning(robot)[:, :2] - robot.truth[:, :2]
            found["dead_reckoning_rmse_m"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        robots[path.name] = found
    summary: dict[str, Any] = {
        "log": log.name,
        "method": method,
        "association": association,
        "landmarks": len(result.landmarks),
        "sightings": sum(len(z) for robot in log.robots for z in robot.observations),
        "rejected": result.rejected,
        "cpu_s": result.seconds,
        "robots": robots,
    }
    if result.chi2 is not None:
        summary |= {"chi2": result.chi2, "degrees_of_freedom": result.degrees_of_freedom}
    error_m = landmark_error(log, result, association)
    return summary if error_m is None else summary | {"landmark_rmse_m": error_m}


def landmark_error(log: PlanarLog, result: PlanarResult, association: str) -> float | None:
    """RMSE of the landmarks, m; against the nearest true ones where the association was not known."""
    if not log.landmarks or not len(result.landmarks):
        return None
    true = np.array(list(log.landmarks.values()))
    distance = np.linalg.norm(result.landmarks[:, None] - true[None], axis=2)
    if association == "known":
        number = {landmark: k for k, landmark in enumerate(log.landmarks)}
        rows = [(k, number[int(i)]) for k, i in enumerate(result.landmark_ids) if int(i) in number]
        chosen = np.array([distance[a, b] for a, b in rows])
    else:
        chosen = distance.min(axis=1)
    return float(np.sqrt(np.mean(chosen**2)))


def write_tables(folder: Path, log: PlanarLog, result: PlanarResult) -> None:
    """``path_<robot>.csv`` (stamp, pose, and the covariance where it was computed) and ``landmarks.csv``."""
    names = "stamp_s,x_m,y_m,heading_rad,P_xx,P_xy,P_xh,P_yy,P_yh,P_hh"
    for robot, path in zip(log.robots, result.paths, strict=True):
        upper = np.full((len(path.poses), 6), np.nan)
        upper[path.known] = path.covariances[:, *np.triu_indices(3)]
        table = np.column_stack([robot.stamps, path.poses, upper])
        np.savetxt(folder / f"path_{path.name}.csv", table, "%.9g", ",", header=names, comments="")
    table = np.column_stack([result.landmark_ids, result.landmarks])
    np.savetxt(folder / "landmarks.csv", table, ("%d", "%.6f", "%.6f"), ",", header="id,x_m,y_m", comments="")


def draw(path: Path, log: PlanarLog, result: PlanarResult) -> None:
    """The map from above: paths, landmarks, and the truth dashed."""
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    for colour, robot, found in zip(COLOURS * len(log.robots), log.robots, result.paths, strict=False):
        if robot.truth is not None:
            axes.plot(*robot.truth[:, :2].T, "--", color="0.5", linewidth=0.8)
        axes.plot(*found.poses[:, :2].T, color=colour, linewidth=1.0, label=found.name)
    axes.plot(*result.landmarks.T, "^", color="#b36b00", markersize=6, label="landmarks")
    if log.landmarks:
        axes.plot(*np.array(list(log.landmarks.values())).T, "o", mfc="none", color="0.2", label="true landmarks")
    axes.set_aspect("equal", adjustable="box")
    axes.grid(color="0.92")
    axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{log.name}: {len(result.landmarks)} landmarks")
    axes.legend(fontsize=8)
    save_png(path, figure)
