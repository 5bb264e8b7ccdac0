# SPDX-License-Identifier: Apache-2.0
"""Ambiguity of a global search: another minimum that explains the scan as well makes the answer doubtful.

Where two scans share little, a wrong pose can look as good as the true one. An answer is doubted where another minimum
costs hardly more; one that lies near widens the covariance instead.
"""

from __future__ import annotations

import numpy as np

from ndt_registration.methods.search import SEPARATION, Candidate, pose_distance
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus

_MARGIN = 0.02
"""Cost by which the answer must beat every rival."""
_GATE = chi_square_bound(0.999, 6)
"""Squared Mahalanobis distance within which a pose is no rival: the covariance covers it."""


def ambiguity_reason(
    best: Candidate,
    others: list[Candidate],
    covariance: FloatArray,
    scale: float,
) -> str:
    """Reason for which the best of a search's poses cannot be trusted, "" if it can.

    Parameters
    ----------
    best, others
        The answer and the other minima.
    covariance
        Shape (6, 6), of the answer; poses that it covers, such as those along a corridor, are no rivals.
    scale
        Scale of the target, m.
    """
    for other in others:
        if other.cost < best.cost + _MARGIN and _differs(best, other, covariance, scale):
            return f"ambiguous: a pose {_difference(best.T, other.T)} away explains the scan about equally well"
    return ""


def spread_of_neighbours(minima: list[Candidate], scale: float) -> FloatArray:
    """Covariance (6, 6) of the minima near the first that cost hardly more: any of them may be the true one."""
    best = minima[0]
    near = [
        boxminus(other.T, best.T)
        for other in minima
        if other.cost < best.cost + _MARGIN and pose_distance(other.T, best.T, scale) <= SEPARATION
    ]
    offsets = np.array(near)
    return np.asarray(offsets.T @ offsets / len(near))


def _differs(best: Candidate, other: Candidate, covariance: FloatArray, scale: float) -> bool:
    d = boxminus(other.T, best.T)
    return bool(pose_distance(other.T, best.T, scale) > SEPARATION and d @ np.linalg.solve(covariance, d) > _GATE)


def _difference(T: FloatArray, other: FloatArray) -> str:
    d = boxminus(other, T)
    return f"{np.linalg.norm(d[:3]):.2f} m and {np.rad2deg(np.linalg.norm(d[3:])):.1f} deg"
