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
_STEPS = 10


@dataclass(frozen=True, eq=False)
class FixedFrame:
    """``T`` = T_map_frame (4, 4), and a mask (n,) of the positions that agree."""

    T: FloatArray
    agrees: BoolArray


def find_frame(antenna: FloatArray, positions: FloatArray, noise: FloatArray, drift: FloatArray) -> FixedFrame | None:
    """The frame of some positions; None unless most agree and are spread along two directions.

    A map that is bent along its way feigns a spread that is not there, however many positions there are.

    Parameters
    ----------
    antenna
        Where the map has the antenna, (n, 3) m.
    positions
        Where it was in the fixed frame, (n, 3) m.
    noise
        Variance of each position along any axis, (n,) m2.
    drift
        Variance that the map's own places have against each other, which does not average out, (n,) m2.
    """
    n = len(antenna)
    if n < _FEWEST:
        return None
    reach, least = np.sqrt(_INSIDE * (noise + drift)), max(_FEWEST, int(np.ceil(_SHARE * n)))
    coarse = ransac_rigid_transform(positions, antenna, reach, np.random.default_rng(1), min_inliers=least)
    if not coarse.success:
        return None
    T, agrees = coarse.T, coarse.inliers
    for _ in range(_STEPS):
        T = _step(T, antenna, positions, 1.0 / (noise + drift), agrees)
        agrees = np.linalg.norm(antenna - transform_points(T, positions), axis=1) <= reach
        if agrees.sum() < least:
            return None
    sure = _information(antenna[agrees], 1.0 / (noise + agrees.sum() * drift)[agrees])
    sigma = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(sure)[3:, 3:])[-1])
    return FixedFrame(T, agrees) if sigma <= LARGEST_ANGLE else None


def _step(
    T: FloatArray, antenna: FloatArray, positions: FloatArray, weight: FloatArray, agrees: BoolArray
) -> FloatArray:
    """A Gauss-Newton step."""
    places, w = antenna[agrees], weight[agrees]
    error = places - transform_points(T, positions[agrees])
    J, middle = _jacobian(places)
    d = np.linalg.solve(_information(places, w), np.einsum("nij,n,ni->j", J, w, error))
    d[:3] -= np.cross(d[3:], middle)
    return boxplus(T, d)


def _information(places: FloatArray, weight: FloatArray) -> FloatArray:
    """Information (6, 6) of a transform to some places (n, 3), about their middle."""
    J, _ = _jacobian(places)
    return np.asarray(np.einsum("nij,n,nil->jl", J, weight, J) + 1e-9 * np.eye(6))


def _jacobian(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivative (n, 3, 6) of what a transform leads to, turned about the middle (3,) of that.

    At the map's places, which are the sure ones: noise of positions would feign a spread that is not there.
    """
    middle = places.mean(axis=0)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(places), 3, 3)), -skew(places - middle)], axis=2), middle
