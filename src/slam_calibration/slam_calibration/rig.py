# SPDX-License-Identifier: Apache-2.0
"""Calibration of a rig of cameras from what they saw of a board: the order of the steps, and what is refused.

each camera alone: first lens -> board poses -> bundle  |  all together: camera positions -> joint bundle -> checks
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam_calibration.bundle import BundleConfig, BundleResult, LensState, Rig, Views, adjust
from slam_calibration.detection import NOTHING, Corners
from slam_calibration.initialisation import board_pose, initial_extrinsics, initial_lens, is_posable
from slam_calibration.lens import parameter_names
from slam_core.config import Config, group, parameter
from slam_core.geometry import FloatArray, invert_transform


@dataclass(frozen=True)
class CalibrationConfig(Config):
    """Settings of a calibration."""

    minimum_views: int = parameter(4, "views of the board that each camera needs", minimum=3)
    largest_relative_deviation: float = parameter(
        0.02,
        "standard deviation of focal length over focal length, and of the principal point over the image size, above "
        "which the parameter counts as unobservable",
        minimum=1e-6,
    )
    outlier_multiple: float = parameter(
        6.0, "residual, in robust standard deviations of all residuals, beyond which a corner is dropped", minimum=2.0
    )
    bundle: BundleConfig = group(BundleConfig)


def calibrate(
    board_points: FloatArray,
    views: Views,
    sizes: Sequence[tuple[int, int]],
    lenses: Sequence[str],
    config: CalibrationConfig | None = None,
) -> BundleResult:
    """Calibrate one camera or a rig of several.

    Parameters
    ----------
    board_points
        Corners on the board by id, shape (n, 3), m.
    views
        ``views[v][c]``: corners that camera c saw in view v; empty where it saw none.
    sizes
        (width, height) of each camera's pictures, px.
    lenses
        What to estimate of each camera, see :mod:`slam_calibration.lens`.
    config
        Settings; None: the defaults.

    Raises
    ------
    ValueError
        For too few views, no view in common, or a parameter that the views do not determine; the message says which.
    """
    config = config or CalibrationConfig()
    for lens in lenses:
        parameter_names(lens)
    views = [[k if is_posable(board_points, k) else NOTHING for k in view] for view in views]
    alone = [
        _calibrate_alone(board_points, [view[c] for view in views], size, lens, c, config)
        for c, (size, lens) in enumerate(zip(sizes, lenses, strict=True))
    ]
    several = len(alone) > 1
    cameras = [a.rig.cameras[0] for a in alone]
    result = _calibrate_together(board_points, views, cameras, config) if several else alone[0]
    _check_observable(result, config)
    return result


def _calibrate_alone(
    board_points: FloatArray,
    seen: Sequence[Corners],
    size: tuple[int, int],
    lens: str,
    c: int,
    config: CalibrationConfig,
) -> BundleResult:
    shown = sum(len(corners) > 0 for corners in seen)
    if shown < config.minimum_views:
        raise ValueError(
            f"camera {c + 1} shows the board in {shown} pictures, at least {config.minimum_views} are needed"
        )
    state = initial_lens(board_points, seen, *size, lens)
    views = [[corners] for corners in seen]
    result = _adjust_from(board_points, views, [state], config)
    # Poses found again with the lens now known escape the mirrored pose that a rough lens may have preferred.
    again = _adjust_from(board_points, views, [result.rig.cameras[0]], config)
    return again if again.rms < result.rms else result


def _calibrate_together(
    board_points: FloatArray, views: Views, states: Sequence[LensState], config: CalibrationConfig
) -> BundleResult:
    placed = [states[0]]
    for c in range(1, len(states)):
        placed.append(replace(states[c], T=initial_extrinsics(board_points, views, states, c)))
    return _adjust_from(board_points, views, placed, config)


def _adjust_from(
    board_points: FloatArray, views: Views, states: Sequence[LensState], config: CalibrationConfig
) -> BundleResult:
    """Bundle with board poses from the camera that explains each view best, then again without outliers."""
    nothing = (np.eye(4), 0.0, states[0])
    poses = []
    for view in views:
        candidates = [(*board_pose(board_points, k, s), s) for k, s in zip(view, states, strict=True) if len(k)]
        T_camera_board, _, state = min(candidates, key=lambda candidate: candidate[1], default=nothing)
        poses.append(invert_transform(state.T) @ T_camera_board)
    result = adjust(board_points, views, Rig(tuple(states), tuple(poses)), config.bundle)
    for _ in range(2):
        result = adjust(board_points, _inliers(board_points, result, config), result.rig, config.bundle)
    return result


def _inliers(board_points: FloatArray, result: BundleResult, config: CalibrationConfig) -> Views:
    """The corners whose residual is no outlier; a picture left with too few is left out."""
    lengths = [[np.linalg.norm(r, axis=1) for r in view] for view in result.residuals]
    median = np.median(np.concatenate([length for view in lengths for length in view]))
    limit = config.outlier_multiple * median / np.sqrt(2.0 * np.log(2.0))  # median of a Rayleigh distribution
    kept = []
    for view, view_lengths in zip(result.views, lengths, strict=True):
        good = [Corners(k.ids[n <= limit], k.pixels[n <= limit]) for k, n in zip(view, view_lengths, strict=True)]
        kept.append([k if is_posable(board_points, k) else NOTHING for k in good])
    return kept


def _check_observable(result: BundleResult, config: CalibrationConfig) -> None:
    weak = []
    for c, state in enumerate(result.rig.cameras):
        limits = {"fx": state.parameters[0], "fy": state.parameters[1], "cx": state.width, "cy": state.height}
        for name, scale in limits.items():
            deviation = result.standard_deviation(f"{c}.{name}")
            if not deviation <= config.largest_relative_deviation * abs(scale):
                weak.append(f"{name} of camera {c + 1} (+-{deviation:.3g} px)")
    if weak:
        raise ValueError(
            f"these views do not determine {', '.join(weak)}: tilt the board by 20 to 40 degrees in several directions "
            "and fill the picture"
        )
    if not np.isfinite(result.rms):
        raise ValueError("the calibration did not converge: are the pictures of one camera and the board as described?")
