# SPDX-License-Identifier: Apache-2.0
"""Section 9.1.1, Fig. 9.6: the dense model of the workshop, against the true surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from slam_core.geometry import transform_points
from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.experiments.chain import mapped
from slam_experiments.experiments.filtering import frames
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept, load
from slam_simulation import Scenario
from slam_simulation.rendering.surface_distance import distance_to_surfaces

MODULE = "slam_experiments.experiments.dense"
_SCENARIO = "workshop_rig"
_NEAR_M = 3.0
_MOST_POINTS = 20_000
_MARK_M = 0.02


def to_true_surfaces(folder: Path, before: list[Path]) -> Kept:
    """Distances of the model's points near the way from the nearest true surface, the first pose at the true one."""
    run = load(before[0]).arrays
    poses, truth = run["0 joined poses"], run["0 joined truth"]
    T_truth_map = truth[0] @ np.linalg.inv(poses[0])
    points = transform_points(T_truth_map, run["dense_points"].astype(np.float64))
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    way = truth[:: max(1, len(truth) // 50), :3, 3]
    near = points[np.linalg.norm(points[:, None] - way[None], axis=2).min(axis=1) < _NEAR_M]
    return {}, {"points": near, "distance": distance_to_surfaces(Scenario.load(_SCENARIO).world(), near), "way": truth}


def _experiment() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        run = mapped(_SCENARIO, frames=frames(quick))
        return {"model": Job(f"{MODULE}:to_true_surfaces", {}, RENDERING, (run,))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        arrays = results["model"].arrays
        quantiles = 1e3 * np.percentile(arrays["distance"], [50, 90, 95])
        beyond = 100.0 * float(np.mean(arrays["distance"] > 0.1))
        row = [str(len(arrays["distance"])), *(f"{q:.1f}" for q in quantiles), f"{beyond:.2f}"]
        return Findings(
            [Comparison("distance of the model's points from the true surfaces, median", thesis.MODEL,
                        f"{quantiles[0]:.1f} mm", f"<= {1e3 * _MARK_M:.0f} mm", bool(quantiles[0] <= 1e3 * _MARK_M))],
            [Table(f"Points within {_NEAR_M:g} m of the way", ("points", "median mm", "90 % mm", "95 % mm",
                                                               "beyond 10 cm %"), [row])],
            [Picture(_model(arrays), "9.6", "The dense model, coloured by its distance from the true surfaces.")],
        )  # fmt: skip

    return Experiment("dense_model", "9.1.1", "A dense model of the workshop", jobs, report)


def _model(arrays: Mapping[str, np.ndarray]) -> Figure:
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    points = arrays["points"]
    low, high = plots.box_of(points, 0.0)
    inside = np.all((points >= low) & (points <= high), axis=1)
    drawn = axes.scatter(
        *points[inside].T, s=2, c=1e3 * arrays["distance"][inside], cmap="viridis", vmin=0.0, vmax=50.0, linewidths=0
    )
    axes.plot(*arrays["way"][:, :3, 3].T, color=plots.ESTIMATE, linewidth=1.4)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect(high - low)
    figure.colorbar(drawn, ax=axes, label="distance [mm]", shrink=0.6)
    return figure


EXPERIMENTS = (_experiment(),)
