# SPDX-License-Identifier: Apache-2.0
"""The camera info that a pair should have had, from what self-calibration says its rectification is wrong by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_core.camera import CameraInfo
from slam_core.geometry import FloatArray, so3_exp, so3_log
from stereo_frontend.stereo.rectification_error import RectificationError

_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
_GRID = 16


def corrected_right(info: CameraInfo, error: RectificationError) -> tuple[CameraInfo, float]:
    """The right camera's info with the error taken out, and what the fit of lens and rotation leaves of it, px.

    P stays, so the left info goes with it as it is. ``error`` is that of images rectified with ``info``.
    """
    from scipy.optimize import least_squares  # 10 MB that only a run with such an error needs

    target = error.camera
    u, v = np.meshgrid(np.linspace(0, target.width - 1, _GRID), np.linspace(0, target.height - 1, _GRID))
    ideal = np.column_stack([u.ravel(), v.ravel()])
    rays = target.unproject(ideal, np.ones(len(ideal)))
    seen = ideal + np.column_stack([error.columns(ideal), error.rows(ideal, np.zeros(len(ideal)))])
    raw = info.camera.project(target.unproject(seen, np.ones(len(seen))) @ info.R)
    known = np.isfinite(raw).all(axis=1)

    def residual(x: FloatArray) -> FloatArray:
        trial = _with(info, x)
        return np.asarray((trial.camera.project(rays[known] @ trial.R) - raw[known]).ravel())

    start = _parameters(info)
    solution = least_squares(residual, start, x_scale=np.maximum(np.abs(start), 0.01))
    return _with(info, solution.x), float(np.sqrt(2.0 * np.mean(solution.fun**2)))


def _model(info: CameraInfo) -> str:
    return "plumb_bob" if info.camera.distortion_model == "none" else info.camera.distortion_model


def _parameters(info: CameraInfo) -> FloatArray:
    c = info.camera
    distortion = np.zeros(_COEFFICIENTS[_model(info)])
    distortion[: len(c.distortion)] = c.distortion
    return np.concatenate([[c.fx, c.fy, c.cx, c.cy], so3_log(info.R), distortion])


def _with(info: CameraInfo, x: FloatArray) -> CameraInfo:
    fx, fy, cx, cy = (float(v) for v in x[:4])
    distortion = tuple(float(v) for v in x[7:])
    camera = replace(info.camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion_model=_model(info), distortion=distortion)
    return CameraInfo(camera, so3_exp(x[4:7]), info.P)
