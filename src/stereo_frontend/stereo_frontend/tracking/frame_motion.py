# SPDX-License-Identifier: Apache-2.0
"""Motion of a camera between two pictures from points of the first that are found again in the second.

Robust least squares of the reprojection errors (Cauchy's loss at the residuals' own robust spread). It predicts where
and under which warp patches are found; a filter's estimate it is not.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.camera import Camera
from slam_core.estimation.least_squares import MAD_TO_SIGMA
from slam_core.geometry import FloatArray, make_transform, so3_exp, so3_log
from slam_core.linear_algebra.small_kernels import rotate_columns
from stereo_frontend.stereo.patch_alignment import factorise, substitute

_LEAST_POINTS = 8
_ITERATIONS = 12
_LEAST_SPREAD_PX = 0.2


def scaled_motion(T: FloatArray, factor: float) -> FloatArray:
    """The motion (4, 4) of ``factor`` times the duration at the same velocities."""
    return make_transform(so3_exp(factor * so3_log(T[:3, :3])), factor * T[:3, 3])


def fit_motion(points: FloatArray, uv: FloatArray, camera: Camera, start: FloatArray) -> FloatArray | None:
    """``T_now_before`` (4, 4) of the optical frame, from ``start``; None where few points agree.

    Points (n, 3) m of the frame before are found at pixels (n, 2).
    """
    if len(points) < _LEAST_POINTS:
        return None
    xy = camera.normalised_from_pixels(uv)
    T = start.copy()
    residual = np.empty(len(points))
    if not _fit(points, xy, T, _LEAST_SPREAD_PX / camera.fx, residual):
        return None
    agree = residual < 3.0 * max(_LEAST_SPREAD_PX / camera.fx, MAD_TO_SIGMA * float(np.median(residual)))
    spread_is_small = float(np.median(residual)) < 3.0 / camera.fx
    return T if spread_is_small and agree.sum() >= max(_LEAST_POINTS, 0.4 * len(points)) else None


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(points, xy, T, least_spread, residual):  # type: ignore[no-untyped-def]
    """Move T to the best fit and fill the residuals' lengths (n,); False if the points do not determine it."""
    normal, step = np.empty((6, 6)), np.empty(6)
    J = np.empty((2, 6))
    spread = np.inf
    for iteration in range(_ITERATIONS):
        normal[:], step[:] = 0.0, 0.0
        for n in range(len(points)):
            p = points[n]
            x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
            y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
            z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
            if not z > 0.01:
                residual[n] = 1.0
                continue
            w = 1.0 / z
            a, b = x * w, y * w
            du, dv = xy[n, 0] - a, xy[n, 1] - b
            residual[n] = np.sqrt(du * du + dv * dv)
            weight = 1.0 / (1.0 + (residual[n] / spread) ** 2)
            J[0, 0], J[0, 1], J[0, 2], J[0, 3], J[0, 4], J[0, 5] = w, 0.0, -a * w, -a * b, 1.0 + a * a, -b
            J[1, 0], J[1, 1], J[1, 2], J[1, 3], J[1, 4], J[1, 5] = 0.0, w, -b * w, -1.0 - b * b, a * b, a
            for i in range(6):
                step[i] += weight * (J[0, i] * du + J[1, i] * dv)
                for j in range(i + 1):
                    normal[i, j] += weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
        spread = max(least_spread, MAD_TO_SIGMA * np.median(residual))
        for i in range(6):
            normal[i, i] *= 1.0 + 1e-9
        if not factorise(normal):
            return False
        substitute(normal, step)
        _move(T, step)
        if iteration > 3 and np.sum(np.abs(step)) < 1e-6:
            break
    return bool(np.isfinite(T).all())


@njit(cache=True, nogil=True, error_model="numpy")
def _move(T, step):  # type: ignore[no-untyped-def]
    """``T <- (exp of the step's rotation, its translation) T``."""
    rotate_columns(T, step[3], step[4], step[5], 4)
    for i in range(3):
        T[i, 3] += step[i]


def facing_warp(T_now_before: FloatArray, points: FloatArray) -> FloatArray:
    """Affine parts (n, 4), row by row, by which the motion changes patches that face the camera, of points (n, 3)."""
    moved = points @ T_now_before[:3, :3].T + T_now_before[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, scale = moved[:, :2] / moved[:, 2:], points[:, 2] / moved[:, 2]
    R = T_now_before[:3, :3]
    rows = [scale * (R[i, j] - xy[:, i] * R[2, j]) for i in range(2) for j in range(2)]
    return np.column_stack(rows)
