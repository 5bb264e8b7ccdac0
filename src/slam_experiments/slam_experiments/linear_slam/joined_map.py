# SPDX-License-Identifier: Apache-2.0
"""The picture of joined text submaps: from above, and from the side where they are 3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from slam_core.estimation.chi_square import ELLIPSE_PROBABILITY, chi_square_bound
from slam_experiments.linear_slam.text_joining import TextJoiningResult
from slam_viewer.report.figures import COLOURS, save_png

_FEATURES = "#b36b00"


def draw_joined(path: Path, result: TextJoiningResult) -> None:
    """Write the picture: poses in the order of their ids, features, and 99.5 % ellipses of both."""
    views = [(0, 1)] if result.features.shape[1] == 2 else [(0, 1), (0, 2)]
    figure = Figure(figsize=(9.0 * len(views), 8.0), layout="constrained")
    for axes, (a, b) in zip(np.atleast_1d(figure.subplots(1, len(views))), views, strict=True):
        _draw(axes, result, a, b)
    save_png(path, figure)


def _draw(axes: Axes, result: TextJoiningResult, a: int, b: int) -> None:
    d = result.features.shape[1]
    order = np.argsort(np.abs(result.pose_ids))
    if len(result.features):
        points, covariances = result.features[:, [a, b]], result.feature_covariances[:, [[a], [b]], [a, b]]
        axes.plot(*points.T, ".", color=_FEATURES, markersize=3, label=f"{len(points)} features")
        _ellipses(axes, points, covariances, _FEATURES)
    poses = result.poses[order][:, :d][:, [a, b]]
    axes.plot(*poses.T, color=COLOURS[1], linewidth=1.0, label=f"{len(poses)} poses")
    _ellipses(axes, poses, result.pose_covariances[order][:, [[a], [b]], [a, b]], COLOURS[1])
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(color="0.92")
    axes.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
    axes.set_title(f"chi2 {result.chi2:.6g}; ellipses hold {100 * ELLIPSE_PROBABILITY:g} %", fontsize=10)
    axes.legend(fontsize=8)


def _ellipses(axes: Axes, centres: np.ndarray, covariances: np.ndarray, colour: str) -> None:
    values, vectors = np.linalg.eigh(covariances)
    lengths = 2.0 * np.sqrt(np.maximum(values, 0.0) * chi_square_bound(ELLIPSE_PROBABILITY, 2))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(EllipseCollection(
        lengths[:, 1], lengths[:, 0], angles, units="xy", offsets=centres, offset_transform=axes.transData,
        facecolors="none", edgecolors=colour, linewidths=0.4, alpha=0.5,
    ))  # fmt: skip
