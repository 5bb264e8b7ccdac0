# SPDX-License-Identifier: Apache-2.0
"""Frames of a simulated room with true depth and poses, and what they say about features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slam_core.estimation.least_squares import MAD_TO_SIGMA
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import DepthImage, StereoImages
from slam_simulation import Scenario, Simulator
from slam_simulation.simulator import DepthTruth
from stereo_frontend.stereo.rectify import StereoRectifier
from tof_driver.depth import DepthConfig, DepthProcessor


@dataclass(frozen=True, eq=False)
class TrueFrame:
    """A rectified pair, the ToF depth image, true depth of the left image and the pose of the left optical frame."""

    images: StereoImages
    depth: DepthImage | None
    truth: DepthTruth
    T_world_left: FloatArray
    T_left_tof: FloatArray


def simulated_frames(scenario: str, frames: int, step: int = 1) -> Iterator[TrueFrame]:
    """Every ``step``-th of the first ``frames * step`` frames of a scenario."""
    simulator = Simulator(Scenario.load(scenario), truth=True)
    rectifier = StereoRectifier(*simulator.stereo.infos)
    tof = DepthProcessor(DepthConfig(), simulator.tof.camera)
    for frame in simulator.run(frames * step):
        if frame.index % step or frame.left is None or frame.right is None or frame.truth is None:
            continue
        images = rectifier(frame.stamp_ns, frame.left, frame.right)
        depth = None
        if frame.tof is not None:
            depth = tof.process(frame.stamp_ns, frame.tof.range, frame.tof.amplitude, frame.tof.intensity)
        yield TrueFrame(images, depth, frame.truth, frame.T_world_rig @ simulator.T_rig_left, simulator.T_left_tof)


def true_depth(truth: DepthTruth, uv: np.ndarray) -> FloatArray:
    """True depth (n,) m at positions (n, 2) px of the left image; NaN at the edges of surfaces."""
    height, width = truth.depth.shape
    finite = np.nan_to_num(np.asarray(uv, np.float64), nan=-9.0)
    u = np.clip(np.round(finite[:, 0]).astype(int), 1, width - 2)
    v = np.clip(np.round(finite[:, 1]).astype(int), 1, height - 2)
    same = np.all(np.abs(finite - np.column_stack([u, v])) <= 0.5, axis=1)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            same &= truth.surface[v + dv, u + du] == truth.surface[v, u]
    inverse = 1.0 / np.where(truth.depth > 0, truth.depth, np.nan).astype(np.float64)
    slope_u = 0.5 * (inverse[v, u + 1] - inverse[v, u - 1])
    slope_v = 0.5 * (inverse[v + 1, u] - inverse[v - 1, u])
    depth = 1.0 / (inverse[v, u] + slope_u * (finite[:, 0] - u) + slope_v * (finite[:, 1] - v))
    return np.where(same, depth, np.nan)


def transfer(first: TrueFrame, second: TrueFrame, uv: np.ndarray) -> FloatArray:
    """Pixels in the second left image of the surface points at ``uv`` (n, 2) px of the first; NaN where hidden."""
    camera = first.images.stereo.camera
    depth = true_depth(first.truth, uv)
    points = camera.unproject(np.asarray(uv, np.float64), depth)
    points = transform_points(invert_transform(second.T_world_left) @ first.T_world_left, points)
    pixels = camera.project(points)
    inside = np.all((pixels >= 8) & (pixels < [camera.width - 8, camera.height - 8]), axis=1)
    u, v = np.where(inside[:, None], pixels, 0).round().astype(int).T
    visible = inside & (np.abs(second.truth.depth[v, u] / points[:, 2] - 1.0) < 0.03)
    return np.where(visible[:, None], pixels, np.nan)


def spread(values: np.ndarray) -> float:
    """Robust standard deviation, ``MAD_TO_SIGMA`` times the median deviation."""
    finite = values[np.isfinite(values)]
    return float(MAD_TO_SIGMA * np.median(np.abs(finite - np.median(finite)))) if len(finite) else float("nan")
