# SPDX-License-Identifier: Apache-2.0
"""Two sets of corresponding points in the plane aligned in closed form (Horn 1987), with covariance and outliers.

``scale target_i = R(yaw) source_i + translation``, where the scale is 1 or an unknown of the target: the source's is
never changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray

MOST_POINTS = 60
_PROBABILITY = 0.999
_FEWEST_WITH_OUTLIERS = 4
_FARTHER_THAN = 10.0
"""Standard deviations between the two points that are farthest apart: with less the rotation is hardly known."""
_REWEIGHTINGS = 3

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PlaneAlignment:
    """An alignment. ``scale``: unit of the source for one of the target.

    ``covariance`` (3, 3) of x, y, yaw; ``scale_sigma`` relative, 0 where the scale was known; ``residuals`` (n, 2) in
    the source's unit; ``inliers`` (n,): the points it was fitted to; ``chi2`` of these with ``freedom`` degrees.
    """

    translation: FloatArray
    yaw: float
    scale: float
    covariance: FloatArray
    scale_sigma: float
    residuals: FloatArray
    inliers: Mask
    chi2: float
    freedom: int


@dataclass(frozen=True, eq=False)
class PlanePoints:
    """Corresponding points (n, 2), each with the standard deviation of a coordinate, (n,) or one for all."""

    source: FloatArray
    target: FloatArray
    source_sigma: FloatArray
    target_sigma: FloatArray
    is_scale_known: bool = True

    def __post_init__(self) -> None:
        n = len(self.source)
        if not 2 <= n <= MOST_POINTS:
            raise ValueError(f"2 to {MOST_POINTS} pairs of points are needed, got {n}")
        for name in ("source_sigma", "target_sigma"):
            object.__setattr__(self, name, np.broadcast_to(np.asarray(getattr(self, name), dtype=np.float64), (n,)))
        if self.source.shape != (n, 2) or self.target.shape != (n, 2):
            raise ValueError(f"points must be (n, 2), got {self.source.shape} and {self.target.shape}")
        if not (np.isfinite(self.source).all() and np.isfinite(self.target).all()):
            raise ValueError("points must be finite numbers")
        for sigma in (self.source_sigma, self.target_sigma):
            if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
                raise ValueError("standard deviations of points must be positive")

    def mirrored(self) -> PlanePoints:
        """Copy with the target in a mirror."""
        flipped = self.target * np.array([-1.0, 1.0])
        return PlanePoints(self.source, flipped, self.source_sigma, self.target_sigma, self.is_scale_known)


def align_plane(points: PlanePoints) -> PlaneAlignment:
    """The alignment of all points, or with four or more of those that agree.

    Raises
    ------
    ValueError
        If points coincide, are mirrored, or disagree by more than their standard deviations allow; it says which.
    """
    _require_apart(points)
    if (found := _consistent(points)) is not None:
        return found
    if _consistent(points.mirrored()) is not None and len(points.source) > 2:
        raise ValueError(
            "the points are mirrored: they fit where one side is turned over. v of a pixel counts downwards from the "
            "upper edge, y of the map upwards; is the plan seen from below?"
        )
    raise ValueError(_disagreement(points))


def _consistent(points: PlanePoints) -> PlaneAlignment | None:
    """The alignment of all points or of most of them, or None where they contradict each other."""
    everyone = _fit(points, np.ones(len(points.source), dtype=bool))
    if everyone is not None and _agrees(points, everyone):
        return everyone
    return _fit_without_outliers(points) if len(points.source) >= _FEWEST_WITH_OUTLIERS else None


def _fit(points: PlanePoints, used: Mask) -> PlaneAlignment | None:
    """Least squares over the points ``used``; None where their scale is not positive."""
    a, b = points.source[used], points.target[used]
    scale = 1.0 if points.is_scale_known else _extent(a) / _extent(b)
    for _ in range(1 if points.is_scale_known else _REWEIGHTINGS):
        variance = (scale * points.target_sigma[used]) ** 2 + points.source_sigma[used] ** 2
        w = (1.0 / variance) / (1.0 / variance).sum()
        mean_a, mean_b = w @ a, w @ b
        da, db = a - mean_a, b - mean_b
        yaw = float(np.arctan2(w @ (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]), w @ (da * db).sum(axis=1)))
        R = _rotation(yaw)
        if not points.is_scale_known:
            scale = float((w @ (db * (da @ R.T)).sum(axis=1)) / (w @ (db**2).sum(axis=1)))
            if not scale > 0.0:
                return None
    translation = scale * mean_b - R @ mean_a
    residuals = scale * points.target - points.source @ R.T - translation
    J = _jacobian(points, R, scale)[used].reshape(2 * len(a), -1)
    P = np.linalg.inv(J.T @ (J / np.repeat(variance, 2)[:, None]))
    chi2 = float(((residuals[used] ** 2).sum(axis=1) / variance).sum())
    return PlaneAlignment(
        translation=translation, yaw=yaw, scale=scale, covariance=0.5 * (P + P.T)[:3, :3],
        scale_sigma=0.0 if points.is_scale_known else float(np.sqrt(P[3, 3])), residuals=residuals, inliers=used,
        chi2=chi2, freedom=2 * len(a) - J.shape[1],
    )  # fmt: skip


def _jacobian(points: PlanePoints, R: FloatArray, scale: float) -> FloatArray:
    """Derivative of the residuals (n, 2, 3 or 4) by x, y, yaw and, where it is unknown, the logarithm of the scale."""
    turned = points.source @ R.T
    J = np.zeros((len(turned), 2, 3 if points.is_scale_known else 4))
    J[:, 0, 0] = J[:, 1, 1] = -1.0
    J[:, 0, 2], J[:, 1, 2] = turned[:, 1], -turned[:, 0]
    if not points.is_scale_known:
        J[:, :, 3] = scale * points.target
    return J


def _agrees(points: PlanePoints, fit: PlaneAlignment) -> bool:
    """True if the residuals of the points that were used are as small as their standard deviations say."""
    if fit.freedom == 0:
        return True
    squares = _squares(points, fit)[fit.inliers]
    is_each = bool(squares.max() <= chi_square_bound(_PROBABILITY, 2))
    return is_each and fit.chi2 <= chi_square_bound(_PROBABILITY, fit.freedom)


def _squares(points: PlanePoints, fit: PlaneAlignment) -> FloatArray:
    """Squared residuals (n,) by the variance of the point."""
    variance = (fit.scale * points.target_sigma) ** 2 + points.source_sigma**2
    return np.asarray((fit.residuals**2).sum(axis=1) / variance)


def _fit_without_outliers(points: PlanePoints) -> PlaneAlignment | None:
    """The alignment that most points agree with, more than half and at least three; None where there is none.

    Each pair of points is one hypothesis, the points near it are fitted, and those that then fit worst are let go.
    """
    n, best = len(points.source), None
    for pair in combinations(range(n), 2):
        used = np.zeros(n, dtype=bool)
        used[list(pair)] = True
        if np.linalg.norm(np.diff(points.source[used], axis=0)) <= 0.0 or _extent(points.target[used]) <= 0.0:
            continue
        fit = _fit(points, used)
        if fit is None:
            continue
        fit = _grown(points, fit)
        if fit.inliers.sum() < max(3, n // 2 + 1):
            continue
        if best is None or (fit.inliers.sum(), -fit.chi2) > (best.inliers.sum(), -best.chi2):
            best = fit
    return best


def _grown(points: PlanePoints, fit: PlaneAlignment) -> PlaneAlignment:
    """The fit with, one after the other, the nearest point that goes with those it has."""
    while not fit.inliers.all():
        outside = np.flatnonzero(~fit.inliers)
        nearest = outside[np.argmin(_squares(points, fit)[outside])]
        used = fit.inliers.copy()
        used[nearest] = True
        more = _fit(points, used)
        if more is None or not _agrees(points, more):
            break
        fit = more
    return fit


def _require_apart(points: PlanePoints) -> None:
    sides = ((points.source, points.source_sigma, "in the map"), (points.target, points.target_sigma, "on the plan"))
    for places, sigma, where in sides:
        apart = np.linalg.norm(places[:, None] - places, axis=2)
        i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
        if apart[i, j] < _FARTHER_THAN * sigma.max():
            who = "points 1 and 2 coincide" if len(places) == 2 else "the points all coincide"
            raise ValueError(
                f"{who} {where}: they are {apart[i, j]:.3g} apart with a standard deviation of {sigma.max():.3g} each; "
                "choose points that are far apart"
            )


def _disagreement(points: PlanePoints) -> str:
    fit = _fit(points, np.ones(len(points.source), dtype=bool))
    if len(points.source) == 2:
        d, e = (float(np.linalg.norm(np.diff(side, axis=0))) for side in (points.source, points.target))
        return (
            f"points 1 and 2 disagree by more than their standard deviations allow: they are {d:.2f} m apart in the "
            f"map and {e:.2f} m on the plan. Is the plan's resolution right?"
        )
    if fit is None:
        return "the points disagree: no turn and scale brings the plan's onto the map's"
    worst = int(np.argmax(_squares(points, fit)))
    off = float(np.linalg.norm(fit.residuals[worst]))
    return (
        f"the points disagree by more than their standard deviations allow: point {worst + 1} is off by the most, "
        f"{off:.2f} m" + ("" if len(points.source) >= _FEWEST_WITH_OUTLIERS else "; a fourth one would tell which is")
    )


def _rotation(yaw: float) -> FloatArray:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def _extent(points: FloatArray) -> float:
    """Root of the summed squared distances from the mean."""
    return float(np.linalg.norm(points - points.mean(axis=0)))
