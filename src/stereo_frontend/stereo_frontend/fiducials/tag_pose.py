# SPDX-License-Identifier: Apache-2.0
"""Pose of a tag from its corners in one or two images, and from depth on it, with its covariance.

Maximum likelihood from the corners' reprojection: Gauss-Newton from both poses under which a small plane looks nearly
the same (Collins and Bartoli 2014, OpenCV's IPPE). Where the second one fits nearly as well, the answer is the mixture
of both, whose covariance covers the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.camera import Camera
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus, boxplus, skew
from slam_core.tags import square

_ITERATIONS = 15
_SMALL_STEP = 1e-9
_NEARLY_AS_WELL = 12.0
"""Difference of chi2 from which on the second pose does not count: its weight is exp(-6)."""
_PROBABILITY = 0.99999
"""Share of true tags that fit."""
_FIT_FACTOR = 4.0
"""Squared errors may be larger than the corners' variance by this: of blur, glare and lenses."""


@dataclass(frozen=True, eq=False)
class TagView:
    """Measurements of a tag: corners ``left`` (4, 2) px and their sigma px.

    right: (4, 2) px in the other image of a rectified pair of ``baseline`` m, with the sigma (4,) px of its columns and
    rows; or None. rays, depth, depth_sigma: normalised pixels (n, 2) on the tag, their depth (n,) m along z and its
    standard deviation (n,) m.
    """

    camera: Camera
    left: FloatArray
    sigma: float
    right: FloatArray | None = None
    right_sigma: FloatArray | None = None
    baseline: float = 0.0
    rays: FloatArray | None = None
    depth: FloatArray | None = None
    depth_sigma: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class TagPose:
    """T_optical_tag (4, 4) with covariance (6, 6); depth (4,) m of the corners along z with its sigma (4,) m.

    chi2 of ``dof`` degrees of freedom: how well the corners fit the size. is_ambiguous: a second pose fits nearly as
    well, and is in the covariance.
    """

    T: FloatArray
    covariance: FloatArray
    depth: FloatArray
    sigma: FloatArray
    chi2: float
    dof: int
    is_ambiguous: bool

    @property
    def fits(self) -> bool:
        """True if the corners are those of a square of that size."""
        return self.chi2 <= _FIT_FACTOR * chi_square_bound(_PROBABILITY, self.dof)


def estimate_tag_pose(view: TagView, size: float) -> TagPose | None:
    """Pose of a tag of ``size`` m, or None where no pose in front of the camera explains the corners."""
    camera = np.array([[view.camera.fx, 0.0, view.camera.cx], [0.0, view.camera.fy, view.camera.cy], [0.0, 0.0, 1.0]])
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(square(size), view.left, camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    except cv2.error:  # corners in a line
        return None
    starts = [
        _transform(np.asarray(turn, np.float64), np.asarray(shift, np.float64))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    solved = [s for T in starts if np.isfinite(T).all() and (s := _refined(view, square(size), T)) is not None]
    if not solved:
        return None
    solved.sort(key=lambda s: s.chi2)
    best = solved[0]
    rivals = [s for s in solved[1:] if s.chi2 - best.chi2 < _NEARLY_AS_WELL and _differ(best, s)]
    return _mixture([best, *rivals[:1]], square(size))


@dataclass(frozen=True, eq=False)
class _Solution:
    T: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int


def _differ(a: _Solution, b: _Solution) -> bool:
    d = boxminus(b.T, a.T)
    return bool(d @ np.linalg.solve(a.covariance + b.covariance, d) > 1.0)


def _refined(view: TagView, corners: FloatArray, T: FloatArray) -> _Solution | None:
    """The nearest optimum to a pose."""
    for _ in range(_ITERATIONS):
        r, J = _residuals(view, corners, T)
        step = np.linalg.lstsq(J, -r, rcond=None)[0]
        T = boxplus(T, np.clip(step, -1.0, 1.0))
        if not (np.isfinite(T).all() and np.all(_points(T, corners)[:, 2] > 0.0)):
            return None
        if np.abs(step).max() < _SMALL_STEP:
            break
    r, J = _residuals(view, corners, T)
    information = J.T @ J
    if np.linalg.cond(information) > 1e14:
        return None
    return _Solution(T, np.asarray(np.linalg.inv(information), np.float64), float(r @ r), len(r) - 6)


def _points(T: FloatArray, corners: FloatArray) -> FloatArray:
    return corners @ T[:3, :3].T + T[:3, 3]


def _point_jacobians(T: FloatArray, corners: FloatArray) -> FloatArray:
    """d(points) / d(pose error), (4, 3, 6)."""
    J = np.zeros((len(corners), 3, 6))
    J[:, :, :3], J[:, :, 3:] = np.eye(3), -skew(corners @ T[:3, :3].T)
    return J


def _residuals(view: TagView, corners: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (m,) of all that is seen, and their Jacobian (m, 6) by the pose's error."""
    X, J = _points(T, corners), _point_jacobians(T, corners)
    rows = [_image_rows(view, X, J, view.left, 0.0, np.full(8, view.sigma))]
    if view.right is not None and view.right_sigma is not None:
        rows.append(_image_rows(view, X, J, view.right, view.baseline, np.repeat(view.right_sigma, 2)))
    if view.depth is not None and len(view.depth):
        rows.append(_depth_rows(view, T))
    return np.concatenate([r for r, _ in rows]), np.concatenate([j for _, j in rows])


def _image_rows(
    view: TagView, X: FloatArray, J: FloatArray, seen: FloatArray, baseline: float, sigma: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Reprojection errors in an image whose camera stands ``baseline`` m to the right."""
    c, z = view.camera, X[:, 2]
    x, y = (X[:, 0] - baseline) / z, X[:, 1] / z
    P = np.zeros((len(X), 2, 3))
    P[:, 0, 0], P[:, 0, 2] = c.fx / z, -c.fx * x / z
    P[:, 1, 1], P[:, 1, 2] = c.fy / z, -c.fy * y / z
    error = np.column_stack([c.fx * x + c.cx, c.fy * y + c.cy]) - seen
    return error.ravel() / sigma, (P @ J).reshape(-1, 6) / sigma[:, None]


def _depth_rows(view: TagView, T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of the depth at which the pixels' rays meet the tag's plane."""
    assert view.rays is not None
    assert view.depth is not None
    assert view.depth_sigma is not None
    n, t = T[:3, 2], T[:3, 3]
    rays = np.column_stack([view.rays, np.ones(len(view.rays))])
    along = rays @ n
    z = (n @ t) / along
    J = np.empty((len(rays), 6))
    J[:, :3] = n / along[:, None]
    J[:, 3:] = (np.cross(n, t) - z[:, None] * np.cross(n, rays)) / along[:, None]
    return (z - view.depth) / view.depth_sigma, J / view.depth_sigma[:, None]


def _mixture(solved: list[_Solution], corners: FloatArray) -> TagPose:
    """Mean and covariance of the poses that explain the corners, weighted by their likelihood (equal priors)."""
    best = solved[0]
    weights = np.exp([-0.5 * (s.chi2 - best.chi2) for s in solved])
    weights /= weights.sum()
    offsets = [boxminus(s.T, best.T) for s in solved]
    mean = sum(w * d for w, d in zip(weights, offsets, strict=True))
    spread = [s.covariance + np.outer(d - mean, d - mean) for s, d in zip(solved, offsets, strict=True)]
    covariance = sum(w * P for w, P in zip(weights, spread, strict=True))
    depths = np.array([_points(s.T, corners)[:, 2] for s in solved])
    variances = np.array([_depth_variances(s, corners) for s in solved])
    depth = weights @ depths
    variance = weights @ (variances + (depths - depth) ** 2)
    return TagPose(
        boxplus(best.T, np.asarray(mean)), np.asarray(covariance), depth, np.sqrt(variance), best.chi2, best.dof,
        len(solved) > 1,
    )  # fmt: skip


def _depth_variances(s: _Solution, corners: FloatArray) -> FloatArray:
    J = _point_jacobians(s.T, corners)[:, 2]
    return np.asarray(np.einsum("ni,ij,nj->n", J, s.covariance, J))


def _transform(turn: FloatArray, shift: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return T
