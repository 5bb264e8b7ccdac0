# SPDX-License-Identifier: Apache-2.0
"""The 3D filter on features without images: its map by either association, and its variances from an unknown heading.

Figs. 4.5, 4.9 and 6.4 of the thesis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from ekf_slam_node.config import EkfSlamConfig, FeatureAssociationConfig, MotionConfig
from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.models import CORE_DIM, Frame, frame_from_features, observe, rig_points, seconds_between
from ekf_slam_node.slam import EkfSlam
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, invert_transform
from slam_experiments.experiments import plots
from slam_experiments.job import RENDERING, Job, JobResult, Kept
from slam_simulation import Scenario
from slam_simulation.feature_level import FeatureFrame, FeatureLevelConfig, FeatureSimulator

MODULE = "slam_experiments.experiments.filter_maps"
_PACKAGES = (*RENDERING, "ekf_slam_node")
_SCENARIO = "workshop_handheld"
_HEADING_SIGMA = 0.5
"""Standard deviation of the first heading, rad, as in section 6.2."""
_DENSITY = 1.0
"""Landmarks per square metre where the map itself is not shown."""
_ELLIPSE = 0.995
"""Share of the landmarks that lie within their ellipses."""
_MIN_SIGMA_PX, _MIN_SIGMA_DEPTH = 0.01, 1e-5
ERRORS = ("standard", "invariant")


def maps(methods: tuple[str, ...], frames: int) -> dict[str, Job]:
    """A map of the workshop by each association."""
    return {f"map, {m}": Job(f"{MODULE}:map_by", {"method": m, "frames": frames}, _PACKAGES) for m in methods}


def unknown_headings(frames: int) -> dict[str, Job]:
    """Variances from an unknown heading on in each error state."""
    function = f"{MODULE}:variances_of_unknown_heading"
    return {f"heading, {e}": Job(function, {"error": e, "frames": frames}, _PACKAGES) for e in ERRORS}


def map_by(folder: Path, before: list[Path], method: str, frames: int) -> Kept:
    """Landmarks with covariances and the path of one filter round the workshop, with an association of that name."""
    simulator = FeatureSimulator(Scenario.load(_SCENARIO))
    config = EkfSlamConfig(association=replace(FeatureAssociationConfig(), method=method))
    endless = replace(config.submap, max_distance=1e6, max_landmarks=10**9, max_frames=10**9)
    slam = EkfSlam(replace(config, submap=endless), simulator.T_rig_left)
    poses, truth = [], []
    for view in simulator.run(frames):
        poses.append(slam.process(view.features).pose.T)
        truth.append(view.T_world_rig)
    found = slam.landmark_view()
    arrays = {"landmarks": found.positions, "covariances": found.covariances, "poses": np.array(poses)}
    relative = np.array([invert_transform(truth[0]) @ T for T in truth])
    error = np.linalg.norm(arrays["poses"][:, :3, 3] - relative[:, :3, 3], axis=1)
    return {"rmse_m": float(np.sqrt(np.mean(error**2)))}, arrays | {"truth": relative}


def variances_of_unknown_heading(folder: Path, before: list[Path], error: str, frames: int) -> Kept:
    """Variances (n, 3) of x, y m2 and heading rad2 over the frames, the first heading unknown, association known."""
    simulator = FeatureSimulator(Scenario.load(_SCENARIO), FeatureLevelConfig(density=_DENSITY))
    motion = MotionConfig()
    covariance = np.zeros((CORE_DIM, CORE_DIM))
    covariance[5, 5] = _HEADING_SIGMA**2
    covariance[6:, 6:] = np.diag(motion.initial_variance)
    ekf, variances, stamp = Ekf(np.zeros(6), covariance, error == "invariant"), [], 0
    slots: dict[int, int] = {}
    for view in simulator.run(frames):
        if stamp:
            ekf.apply_time_update(ekf.time_update(seconds_between(stamp, view.stamp_ns), motion.sigma))
        stamp = view.stamp_ns
        _measure(ekf, view, slots, simulator.T_rig_left)
        variances.append(np.diag(ekf.pose_covariance())[[0, 1, 5]])
    return {}, {"variances": np.array(variances)}


def _measure(ekf: Ekf, view: FeatureFrame, slots: dict[int, int], T_rig_left: FloatArray) -> None:
    """Update with the landmarks that have ``slots`` by their numbers, and give the others one."""
    frame = frame_from_features(view.features, np.arange(len(view.ids)), _MIN_SIGMA_PX, _MIN_SIGMA_DEPTH)
    known = np.array([int(number) in slots for number in view.ids], dtype=bool)
    rows = np.array([slots[int(number)] for number in view.ids[known]], dtype=np.int64)
    seen = observe(ekf.T, T_rig_left, ekf.landmarks[rows], frame.camera)
    ekf.update(frame.z[known], frame.variance[known], seen, rows)
    fresh: Frame = frame.select(~known)
    added = ekf.augment(*rig_points(fresh, T_rig_left))
    slots.update(zip(view.ids[~known].tolist(), added.tolist(), strict=True))


def map_figure(arrays: plots.Arrays) -> Figure:
    """Landmarks as stars with their ellipses, the path dotted, and where the rig looks at the end (Figs. 4.5, 4.9)."""
    figure, axes = plots.new_figure(7, 5.5)
    points, poses, truth = arrays["landmarks"], arrays["poses"], arrays["truth"]
    variances, vectors = np.linalg.eigh(arrays["covariances"][:, :2, :2])
    width, height = 2.0 * np.sqrt(chi_square_bound(_ELLIPSE, 2) * variances.T)
    angle = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    ellipses = EllipseCollection(
        width, height, angle, units="xy", offsets=points[:, :2], offset_transform=axes.transData,
        facecolors="none", edgecolors="#d62728", linewidths=0.5, alpha=0.6,
    )  # fmt: skip
    axes.add_collection(ellipses)
    axes.plot(*points[:, :2].T, "*", color="#d62728", markersize=3, mew=0, label="landmarks, 99.5 % ellipses")
    axes.plot(*truth[:, :2, 3].T, color="#1b9e77", linewidth=1.0, label="ground truth")
    axes.plot(*poses[::3, :2, 3].T, ".", color="black", markersize=3, label="trajectory")
    ahead = poses[-1, :2, 3] + np.outer([0.0, 0.6], poses[-1, :2, 0])
    axes.plot(*ahead.T, color="blue", linewidth=2, label="direction at the end")
    low, high = plots.box_of(np.concatenate([points, poses[:, :3, 3]]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal", adjustable="box")
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    return figure


def variances_figure(results: Mapping[str, JobResult]) -> Figure:
    """Variances of position and heading over the samples, an error state beside the other (Fig. 6.4)."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, len(ERRORS), sharey=True)
    for axes, error in zip(panels, ERRORS, strict=True):
        variances = results[f"heading, {error}"].arrays["variances"]
        for curve, label in zip(variances.T, ("x position [m²]", "y position [m²]", "heading [rad²]"), strict=True):
            axes.plot(curve, linewidth=1.2, label=label)
        axes.axhline(_HEADING_SIGMA**2, color="0.5", linestyle=":", linewidth=1.0, label="heading at the start")
        axes.set(xlabel="sample", title=f"{error} error state")
        axes.grid(color="0.92")
    panels[0].set(ylabel="variance", yscale="log", ylim=(1e-7, 10.0))
    figure.legend(*panels[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    return figure
