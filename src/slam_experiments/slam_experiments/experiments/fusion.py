# SPDX-License-Identifier: Apache-2.0
"""Chapter 11 and section 1.3: what the laser camera adds to the stereo camera, and several firemen in one map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from slam_core.geometry import invert_transform, transform_points
from slam_experiments import thesis
from slam_experiments.experiments import plots
from slam_experiments.experiments.chain import mapped
from slam_experiments.experiments.features import tof_picture
from slam_experiments.experiments.filtering import ACCURACY_HEADER, accuracy_row, bounds_comparison, frames
from slam_experiments.findings import Comparison, Experiment, Findings, Picture, Table
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_experiments.simulated.true_frames import simulated_frames, true_depth
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend_config import MODES

MODULE = "slam_experiments.experiments.fusion"
_PIXELS = "pixels"


def map_pixels(folder: Path, before: list[Path]) -> Kept:
    """Features of a left picture of the small room, and where the laser camera sees what they show."""
    frame = next(simulated_frames("small_room", 1))
    assert frame.depth is not None
    uv = FeatureExtractor(FeatureConfig(target=150))(frame.images.left).uv.astype(np.float64)
    points = frame.images.stereo.camera.unproject(uv, true_depth(frame.truth, uv))
    pixels = frame.depth.camera.project(transform_points(invert_transform(frame.T_left_tof), points))
    seen = np.all((pixels >= 0) & (pixels < frame.depth.depth.shape[::-1]), axis=1)
    pictures = {"left": frame.images.left, "tof": tof_picture(frame.depth, "amplitude")}
    return {}, pictures | {"left pixels": uv[seen], "tof pixels": pixels[seen]}


def _mapped_pixels(arrays: Mapping[str, np.ndarray]) -> Figure:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("left", "tof"), strict=True):
        axes.imshow(arrays[name], cmap="gray")
        pixels = arrays[f"{name} pixels"]
        axes.scatter(*pixels.T, s=18, c=np.arange(len(pixels)), cmap="hsv", edgecolors="white", linewidths=0.4)
        axes.set_axis_off()
    return figure


def _modes() -> Experiment:
    def jobs(quick: bool) -> Mapping[str, Job]:
        runs = {mode: mapped("small_room", mode, frames=frames(quick)) for mode in MODES}
        runs |= {"fuse + ndt": mapped("small_room", "fuse", odometry="ndt", frames=frames(quick))}
        return runs | {_PIXELS: Job(f"{MODULE}:map_pixels", {}, (*RENDERING, "stereo_frontend", "tof_driver"))}

    def report(results: Mapping[str, JobResult]) -> Findings:
        mapping = results[_PIXELS].arrays
        results = {name: result for name, result in results.items() if name != _PIXELS}
        ate = {name: 1e3 * r.values["agents"][0]["joined_ate_m"] for name, r in results.items()}
        best = min(MODES, key=lambda mode: ate[mode])
        comparisons = [Comparison(f"ATE, {mode}", thesis.CH11_ABSENT, f"{ate[mode]:.1f} mm") for mode in MODES] + [
            Comparison("best of the four", thesis.CH11_ABSENT, best, "fuse", best == "fuse"),
            bounds_comparison("small_room", results["fuse"]),
        ]
        return Findings(
            comparisons,
            [Table("The four modes, and with scan odometry", ACCURACY_HEADER,
                   [accuracy_row(name, result) for name, result in results.items()])],
            [Picture(_mapped_pixels(mapping), "11.1", "Pixels of the left picture in the laser camera's."),
             *(Picture(plots.map_view(results[mode].arrays), "", f"Mode {mode}.") for mode in MODES)],
            f"Weighted by their variances, both cameras give {ate['fuse']:.1f} mm; the stereo camera alone "
            f"{ate['stereo']:.1f} mm, the laser camera alone {ate['tof']:.1f} mm.",
        )  # fmt: skip

    return Experiment("modes", "11", "Stereo, laser camera, or both", jobs, report)


def _firemen() -> Experiment:
    names = ("firemen_2", "firemen_3")

    def jobs(quick: bool) -> Mapping[str, Job]:
        return {name: mapped(name, frames=frames(quick)) for name in names}

    def report(results: Mapping[str, JobResult]) -> Findings:
        rows, comparisons = [], []
        for name in names:
            agents = results[name].values["agents"]
            for agent in agents:
                rows.append(
                    [f"{name} {agent['name']}", f"{agent['path_m']:.1f}", f"{1e3 * agent['joined_ate_m']:.1f}",
                     f"{1e3 * agent['joined_end_m']:.1f}", f"{agent['joined_anees']:.2f}"]
                )  # fmt: skip
            worst = max(agent["joined_ate_m"] for agent in agents)
            comparisons.append(
                Comparison(
                    f"{len(agents)} firemen in one map, largest ATE",
                    thesis.FIREMEN,
                    f"{1e3 * worst:.1f} mm",
                    "<= 60 mm, as of one agent",
                    worst <= 0.06,
                )
            )
            comparisons.append(bounds_comparison(name, results[name]))
        return Findings(
            comparisons,
            [Table("Every fireman in the joint map", ("run", "way m", "ATE mm", "end mm", "ANEES"), rows)],
            [Picture(plots.submaps(results[name].arrays, "joined"), "", f"Joint map of {name}.") for name in names],
        )

    return Experiment("firemen", "1.3", "Firemen with helmet cameras share one map", jobs, report)


EXPERIMENTS = (_modes(), _firemen())
