# SPDX-License-Identifier: Apache-2.0
"""Error of a stereo pair from two moments: the same points, measured twice, must fit one rigid motion.

Every match of a keypoint from one frame to the next is measured as (u, v, disparity) twice. Disparities that a wrong
calibration bends make the scene change its shape while the camera moves. The adjustment solves for the motion and the
ten numbers of :mod:`stereo_frontend.stereo.rectification_error` together, robustly, and eliminates the motion: what
remains are normal equations in the calibration, which add up over frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.camera import StereoCamera
from slam_core.geometry import FloatArray, make_transform, so3_exp
from slam_core.runtime.in_place import in_place
from slam_core.types import Float32Array
from stereo_frontend.stereo.normal_equations import MEDIAN_CHI_SQUARE_1, NormalEquations, robust_weights
from stereo_frontend.stereo.rectification_error import RectificationError, column_basis, row_basis

_ITERATIONS = 6
_RANSAC_PX = 3.0
_LEAST_INLIERS = 15
_LEAST_DISPARITY = 0.1
_MEDIAN_CHI_SQUARE_3 = 2.366
"""Median of chi-square of three degrees of freedom."""


@dataclass(frozen=True, eq=False)
class StereoView:
    """Matches of one stereo pair.

    Uv (n, 2) px left, disparity (n,) px as measured with sigma (n,) px, row_shift (n,) px right minus left with
    row_sigma (n,) px, sigma_uv (n,) px, descriptors (n, d).
    """

    stereo: StereoCamera
    descriptors: Float32Array
    uv: FloatArray
    disparity: FloatArray
    sigma: FloatArray
    row_shift: FloatArray
    row_sigma: FloatArray
    sigma_uv: FloatArray

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def uv_right(self) -> FloatArray:
        """Pixels (n, 2) of the partners in the right image."""
        return self.uv - np.column_stack([self.disparity, -self.row_shift])

    def select(self, index: npt.NDArray[np.intp]) -> StereoView:
        """The matches at ``index``."""
        names = ("uv", "disparity", "sigma", "row_shift", "row_sigma", "sigma_uv", "descriptors")
        return replace(self, **{name: getattr(self, name)[index] for name in names})


def match_views(
    first: StereoView, second: StereoView, min_similarity: float, max_ratio: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Indices (k,) of the matches of both that look alike: mutually best, and better than the second best."""
    if not len(first) or not len(second) or first.descriptors.shape[1] != second.descriptors.shape[1]:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    similarity = first.descriptors @ second.descriptors.T
    best, rows = similarity.argmax(axis=1), np.arange(len(first))
    value = similarity[rows, best]
    mutual = similarity.argmax(axis=0)[best] == rows
    similarity[rows, best] = -1.0
    distinct = (1.0 - value) <= max_ratio**2 * (1.0 - similarity.max(axis=1))
    found = np.flatnonzero(mutual & distinct & (value >= min_similarity))
    return found, best[found]


def consistency_equations(first: StereoView, second: StereoView, known: RectificationError) -> NormalEquations | None:
    """Evidence of matched views (equal length, match by match) on the calibration; None without a motion they share.

    ``known`` is where the search starts and holds it; its information is not part of the result.
    """
    T = _first_motion(first, second, known)
    if T is None:
        return None
    prior = np.linalg.inv(known.covariance)
    theta = known.parameters
    noise = 1.0
    bases = _column_jacobian(first), _column_jacobian(second)
    for _ in range(_ITERATIONS):
        residual, J, weight, squares = _linearised(first, second, bases, T, theta)
        noise = max(1.0, float(np.median(squares)) / _MEDIAN_CHI_SQUARE_3)
        robust = robust_weights(squares, noise)
        H, g = _normal(J, np.asarray(robust[:, None, None] * weight), residual)
        H_mm, H_mt, H_tt, g_m, g_t = H[:6, :6], H[:6, 6:], H[6:, 6:], g[:6], g[6:]
        if np.linalg.cond(H_mm) > 1e12:
            return None
        eliminate = np.linalg.solve(H_mm, H_mt).T
        information, gradient = H_tt - eliminate @ H_mt, g_t - eliminate @ g_m
        at = theta
        step = np.linalg.solve(information + prior, -gradient + prior @ (known.parameters - theta))
        theta = theta + step
        turn = np.asarray(np.linalg.solve(H_mm, -(g_m + H_mt @ step)))
        T = make_transform(so3_exp(turn[3:]) @ T[:3, :3], T[:3, 3] + turn[:3])
    return NormalEquations(0.5 * (information + information.T), information @ at - gradient)


def _normal(J: FloatArray, weight: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums ``J^T W J`` (k, k) and ``J^T W r`` (k,) of Jacobians (n, 3, k), weights (n, 3, 3), residuals (n, 3)."""
    rows, weighted = J.reshape(-1, J.shape[2]), (weight @ J).reshape(-1, J.shape[2])
    return rows.T @ weighted, weighted.T @ residual.ravel()


def row_equations(view: StereoView, known: RectificationError, floor_px: float) -> NormalEquations:
    """Evidence of the row differences of one pair, robust; ``floor_px`` is the noise of a perfect match."""
    basis = known.camera.fx * _row_jacobian(view)
    variance = view.row_sigma**2 + floor_px**2
    prior = np.linalg.inv(known.covariance)
    theta: FloatArray = known.parameters
    for _ in range(_ITERATIONS):
        squares = (view.row_shift - basis @ theta) ** 2 / variance
        noise = max(1.0, float(np.median(squares)) / MEDIAN_CHI_SQUARE_1)
        weighted = basis * robust_weights(squares, noise, variance)[:, None]
        evidence = NormalEquations(basis.T @ weighted, weighted.T @ view.row_shift)
        theta = np.asarray(np.linalg.solve(evidence.information + prior, evidence.vector + prior @ known.parameters))
    return evidence


def _row_jacobian(view: StereoView) -> FloatArray:
    c = view.stereo.camera
    return row_basis((view.uv_right - [c.cx, c.cy]) / [c.fx, c.fy], view.disparity / c.fx)


def _first_motion(first: StereoView, second: StereoView, known: RectificationError) -> FloatArray | None:
    """``T_second_first`` by P3P and RANSAC; OpenCV seeds it the same every time."""
    if len(first) < _LEAST_INLIERS:
        return None
    camera = first.stereo.camera
    disparity = np.maximum(first.disparity + known.columns(first.uv_right), _LEAST_DISPARITY)
    depth = first.stereo.depth_from_disparity(disparity)
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        camera.unproject(first.uv, depth),
        second.uv,
        camera.K,
        None,
        reprojectionError=_RANSAC_PX,
        iterationsCount=200,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not ok or inliers is None or len(inliers) < _LEAST_INLIERS:
        return None
    turn, shift = (np.asarray(v, np.float64).ravel() for v in (rotation, translation))
    return make_transform(so3_exp(turn), shift)


def _column_jacobian(view: StereoView) -> FloatArray:
    c = view.stereo.camera
    return c.fx * column_basis((view.uv_right - [c.cx, c.cy]) / [c.fx, c.fy])


def _linearised(
    first: StereoView, second: StereoView, bases: tuple[FloatArray, FloatArray], T: FloatArray, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 3) px of (u, v, disparity), with their Jacobians, information and squares.

    Jacobians (n, 3, 16) by motion (6) and calibration (10); information (n, 3, 3); squares (n,) of the whitened
    residuals. ``bases``: what :func:`_column_jacobian` has of both views.
    """
    n, c = len(first), first.stereo.camera
    residual, J, weight, squares = np.empty((n, 3)), np.empty((n, 3, 16)), np.empty((n, 3, 3)), np.empty(n)
    d1 = np.maximum(first.disparity + bases[0] @ theta, _LEAST_DISPARITY)
    d2 = second.disparity + bases[1] @ theta
    camera = (c.fx, c.fy, c.cx, c.cy, c.fx * first.stereo.baseline)
    measured = (first.uv, d1, first.sigma, first.sigma_uv), (second.uv, d2, second.sigma, second.sigma_uv)
    _linearise(*measured, *bases, T, camera, residual, J, weight, squares)
    return residual, J, weight, squares


@in_place(error_model="numpy")
def _linearise(first, second, basis1, basis2, T, camera, residual, J, weight, squares):  # type: ignore[no-untyped-def]
    """Fill the arrays that :func:`_linearised` returns; ``first`` and ``second`` are (uv, disparity, sigma, sigma_uv).

    ``D`` is the derivative of the prediction by the point in the second camera, ``e`` that by the first disparity.
    """
    fx, fy, cx, cy, fb = camera
    for k in range(len(squares)):
        uv1, d1, uv2, d2 = first[0][k], first[1][k], second[0][k], second[1][k]
        z1 = fb / d1
        x1, y1 = (uv1[0] - cx) / fx * z1, (uv1[1] - cy) / fy * z1
        x = T[0, 0] * x1 + T[0, 1] * y1 + T[0, 2] * z1
        y = T[1, 0] * x1 + T[1, 1] * y1 + T[1, 2] * z1
        z = T[2, 0] * x1 + T[2, 1] * y1 + T[2, 2] * z1
        moved_x, moved_y, w = x + T[0, 3], y + T[1, 3], 1.0 / max(z + T[2, 3], 1e-3)
        r = (uv2[0] - fx * moved_x * w - cx, uv2[1] - fy * moved_y * w - cy, d2 - fb * w)
        D = ((fx * w, 0.0, -fx * moved_x * w * w), (0.0, fy * w, -fy * moved_y * w * w), (0.0, 0.0, -fb * w * w))
        pixel = first[3][k] ** 2 + second[3][k] ** 2
        noise = (pixel, pixel, second[2][k] ** 2)
        e = (
            -(D[0][0] * x + D[0][2] * z) / d1,
            -(D[1][1] * y + D[1][2] * z) / d1,
            -D[2][2] * z / d1,
        )
        for i in range(3):
            a, b, c = D[i]
            J[k, i, 0], J[k, i, 1], J[k, i, 2] = -a, -b, -c
            J[k, i, 3], J[k, i, 4], J[k, i, 5] = b * z - c * y, c * x - a * z, a * y - b * x
            for j in range(basis1.shape[1]):
                J[k, i, 6 + j] = -e[i] * basis1[k, j] + (basis2[k, j] if i == 2 else 0.0)
            residual[k, i] = r[i]
        # Inverse of diag(noise) + s e e^T (Sherman and Morrison 1950).
        share = first[2][k] ** 2
        total = 1.0 + share * (e[0] ** 2 / noise[0] + e[1] ** 2 / noise[1] + e[2] ** 2 / noise[2])
        squares[k] = 0.0
        for i in range(3):
            for j in range(3):
                own = 1.0 / noise[i] if i == j else 0.0
                weight[k, i, j] = own - share * e[i] * e[j] / (noise[i] * noise[j] * total)
                squares[k] += r[i] * weight[k, i, j] * r[j]
