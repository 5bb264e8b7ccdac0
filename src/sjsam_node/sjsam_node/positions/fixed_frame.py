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


def find_frame(antenna: FloatArray, positions: FloatArray, covariances: FloatArray) -> FixedFrame | None:
    """The frame of some positions; None unless most agree and are spread along two directions.

    Parameters
    ----------
    antenna
        Where the map has the antenna, (n, 3) m.
    positions
        Where it was in the fixed frame, (n, 3) m.
    covariances
        Of the difference, (n, 3, 3) m2: a position's own, and what the map may have drifted by.
    """
    n = len(antenna)
    if n < _FEWEST:
        return None
    reach = np.sqrt(_INSIDE * np.linalg.eigvalsh(covariances)[:, -1])
    least = max(_FEWEST, int(np.ceil(_SHARE * n)))
    coarse = ransac_rigid_transform(positions, antenna, reach, np.random.default_rng(1), min_inliers=least)
    if not coarse.success:
        return None
    T = coarse.T
    weight = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
    agrees = coarse.inliers
    for _ in range(_STEPS):
        T, information = _step(T, antenna, positions, weight, agrees)
        error = antenna - transform_points(T, positions)
        agrees = np.einsum("ni,nij,nj->n", error, weight, error) <= _INSIDE
        if agrees.sum() < least:
            return None
    sigma = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[3:, 3:])[-1])
    return FixedFrame(T, agrees) if sigma <= LARGEST_ANGLE else None


def _step(
    T: FloatArray, antenna: FloatArray, positions: FloatArray, weight: FloatArray, agrees: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """A Gauss-Newton step, and the information (6, 6) of the transform about the middle of the positions."""
    # Of the two the map's places are the sure ones: noise of positions would feign a spread that is not there.
    places, W = antenna[agrees], weight[agrees]
    middle = places.mean(axis=0)
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(places), 3, 3)), -skew(places - middle)], axis=2)
    error = places - transform_points(T, positions[agrees])
    information = np.einsum("nij,nik,nkl->jl", J, W, J) + 1e-9 * np.eye(6)
    d = np.linalg.solve(information, np.einsum("nij,nik,nk->j", J, W, error))
    d[:3] -= np.cross(d[3:], middle)
    return boxplus(T, d), information
