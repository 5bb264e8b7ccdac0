# SPDX-License-Identifier: Apache-2.0
"""The fixed frame that positions are in, as the map sees it: found once they are spread enough, outliers or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sjsam_node.graph.landmark_sets import BoolArray
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.rigid_alignment import ransac_rigid_transform
from slam_core.geometry import FloatArray, boxplus, skew, transform_points

LARGEST_ANGLE = 0.15
"""Standard deviation of its rotation about any axis, above which a frame is not determined (rad)."""
_FEWEST = 8
"""Positions that agree, from which on a frame is believed."""
_SHARE = 0.6
"""Least share of the positions that agree."""
_INSIDE = chi_square_bound(0.9999, 3)
"""Squared error of a true position, normalised."""
_SHARES_OF_WORST = (*0.5 ** np.arange(9), 0.0)
"""Of the largest variance in that along every axis, step by step: where outliers have gone, each axis has its own."""


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """``T`` = T_map_frame (4, 4) with its covariance (6, 6), and a mask (n,) of the positions that agree."""

    T: FloatArray
    covariance: FloatArray
    agrees: BoolArray


def find_frame(
    antenna: FloatArray, positions: FloatArray, covariances: FloatArray, drift: FloatArray
) -> FixedFrame | None:
    """The frame of some positions; None unless most agree and are spread along two directions.

    A map that is bent along its way feigns a spread that is not there, however many positions there are.

    Parameters
    ----------
    antenna
        Where the map has the antenna, (n, 3) m.
    positions
        Where it was in the fixed frame, (n, 3) m.
    covariances
        Of each position, (n, 3, 3) m2.
    drift
        Variance that the map's own places have against each other, which does not average out, (n,) m2.
    """
    n = len(antenna)
    if n < _FEWEST:
        return None
    # The frame's axes are not known at first: an error along any of them may be as large as that along the worst.
    worst, own = np.linalg.eigvalsh(covariances)[:, -1, None, None] * np.eye(3), drift[:, None, None] * np.eye(3)
    reach, least = np.sqrt(_INSIDE * (worst[:, 0, 0] + drift)), max(_FEWEST, int(np.ceil(_SHARE * n)))
    coarse = ransac_rigid_transform(positions, antenna, reach, np.random.default_rng(1), min_inliers=least)
    if not coarse.success:
        return None
    T, agrees = coarse.T, coarse.inliers
    for share in _SHARES_OF_WORST:
        P = share * worst + (1.0 - share) * T[:3, :3] @ covariances @ T[:3, :3].T
        T = _step(T, antenna, positions, np.linalg.inv(P + own), agrees)
        error = antenna - transform_points(T, positions)
        agrees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P + own), error) <= _INSIDE
        if agrees.sum() < least:
            return None
    sure = _information(antenna[agrees], np.linalg.inv(P + agrees.sum() * own)[agrees])
    covariance = np.linalg.inv(sure)
    if np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > LARGEST_ANGLE:
        return None
    A = _about_its_origin(T, antenna[agrees])
    return FixedFrame(T, A @ covariance @ A.T, agrees)


def _step(
    T: FloatArray, antenna: FloatArray, positions: FloatArray, weight: FloatArray, agrees: BoolArray
) -> FloatArray:
    """A Gauss-Newton step; ``weight``: information (n, 3, 3) of each position."""
    places, w = antenna[agrees], weight[agrees]
    error = places - transform_points(T, positions[agrees])
    d = np.linalg.solve(_information(places, w), np.einsum("nij,nil,nl->j", _jacobian(places), w, error))
    return boxplus(T, _about_its_origin(T, places) @ d)


def _information(places: FloatArray, weight: FloatArray) -> FloatArray:
    """Information (6, 6) of a transform to some places (n, 3), about their middle."""
    J = _jacobian(places)
    return np.asarray(np.einsum("nij,nil,nlk->jk", J, weight, J, optimize=True) + 1e-9 * np.eye(6))


def _jacobian(places: FloatArray) -> FloatArray:
    """Derivative (n, 3, 6) of what a transform leads to, turned about the middle of that.

    At the map's places, which are the sure ones: noise of positions would feign a spread that is not there.
    """
    turned = -skew(places - places.mean(axis=0))
    return np.concatenate([np.broadcast_to(np.eye(3), (len(places), 3, 3)), turned], axis=2)


def _about_its_origin(T: FloatArray, places: FloatArray) -> FloatArray:
    """Matrix (6, 6) from a change of ``T`` about the middle of some places to one about its origin."""
    A = np.eye(6)
    A[:3, 3:] = skew(places.mean(axis=0) - T[:3, 3])
    return A
