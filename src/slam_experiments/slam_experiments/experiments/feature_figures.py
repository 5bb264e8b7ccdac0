# SPDX-License-Identifier: Apache-2.0
"""Figures of chapter 3: keypoints, matches of a stereo pair, and features on the laser camera's pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from slam_core.geometry import FloatArray
from slam_core.types import AnyArray, ByteArray, StereoImages
from slam_experiments.experiments import plots
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.stereo.matching import MatchingConfig, disparity_bounds, match_stereo

_SHOWN_RATIO = 99.5
"""Percentile of a derivative's size that is drawn white or black."""


def matched_pair(images: StereoImages) -> FloatArray:
    """Rows (n, 5) of SURF features matched in a pair: u, v px, size px in the left image, u, v px in the right one."""
    left, right = (FeatureExtractor(FeatureConfig(target=120))(image) for image in (images.left, images.right))
    config = MatchingConfig()
    bounds = disparity_bounds(config, images.stereo.camera.fx * images.stereo.baseline)
    matches = match_stereo(left, right, config, bounds)
    return np.column_stack([left.uv[matches.left], left.size[matches.left], right.uv[matches.right]]).astype(np.float64)


def keypoint_figure(picture: ByteArray) -> Figure:
    """Keypoints of SURF and SIFT in one picture (Figs. 3.1, 3.2)."""
    figure, axes = plots.new_figure(7, 5.3)
    axes.imshow(picture, cmap="gray")
    for name, colour, marker in (("surf", "#d62728", "o"), ("sift", "#1f77b4", "+")):
        uv = FeatureExtractor(FeatureConfig(detector=name, target=300))(picture).uv
        axes.plot(*uv.T, marker, color=colour, markersize=4, mfc="none", linestyle="", label=name.upper())
    axes.set_axis_off()
    axes.legend(loc="lower right")
    return figure


def match_figure(left: ByteArray, right: ByteArray, matches: FloatArray) -> Figure:
    """Features of :func:`matched_pair` as circles of their size in both images, with lines between (Fig. 3.3)."""
    figure = Figure(figsize=(10, 3.9), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(np.hstack([left, right]), cmap="gray")
    there = matches[:, 3:] + [left.shape[1], 0]
    axes.add_collection(LineCollection(list(np.stack([matches[:, :2], there], axis=1)), colors="#17becf", lw=0.4))
    for places in (matches[:, :2], there):
        sizes = {"widths": matches[:, 2], "heights": matches[:, 2], "angles": np.zeros(len(matches))}
        circles = EllipseCollection(
            **sizes, units="xy", offsets=places, offset_transform=axes.transData, facecolors="none", edgecolors="yellow"
        )
        axes.add_collection(circles)
    axes.set_axis_off()
    return figure


def tof_figure(pictures: Mapping[str, ByteArray]) -> Figure:
    """Features of each of the laser camera's pictures (Fig. 3.4)."""
    return _with_features([(kind, picture, picture) for kind, picture in pictures.items()], rows=1)


def derivative_figure(pictures: Mapping[str, ByteArray]) -> Figure:
    """Features of pictures on their derivatives along x (above) and y (below), where edges are seen (Fig. 3.5)."""
    panels = []
    for name, order in (("x", (1, 0)), ("y", (0, 1))):
        for kind, picture in pictures.items():
            panels.append((f"{kind}, differentiated along {name}", picture, cv2.Sobel(picture, cv2.CV_32F, *order)))
    return _with_features(panels, rows=2)


def _with_features(panels: Sequence[tuple[str, ByteArray, AnyArray]], rows: int) -> Figure:
    """Panels of a title, the picture whose features are drawn, and the one that they are drawn on."""
    columns = len(panels) // rows
    figure = Figure(figsize=(9, 9.6 * rows / columns), layout="constrained")
    for axes, (title, picture, ground) in zip(figure.subplots(rows, columns).flat, panels, strict=True):
        if ground is picture:
            axes.imshow(ground, cmap="gray")
        else:
            limit = np.percentile(np.abs(ground), _SHOWN_RATIO)
            axes.imshow(ground, cmap="gray", vmin=-limit, vmax=limit)
        uv = FeatureExtractor(FeatureConfig(target=150))(picture).uv
        axes.plot(*uv.T, "*", color="#d62728", markersize=4, mew=0)
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    return figure
