# SPDX-License-Identifier: Apache-2.0
"""Two motions in one frame: the room, and a person or thing that moves in it.

Features that the front end has followed agree on the rig's motion to a fraction of what they claim. Where those that
do not agree have a rigid motion of their own, one of the two groups is a thing that moves, the smaller one in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekf_slam_node.association.association import IndexArray
from ekf_slam_node.association.motion_guess import MotionGuess, guess_motion
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.models import Frame
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, boxminus

_HYPOTHESES = 60
"""Samples drawn for each motion."""
_DIFFERENT = chi_square_bound(0.999, 6)
"""Squared normalised difference beyond which two motions are not the same."""
_SMALL = 0.5
"""Size of the smaller group over that of the larger one, below which it is a thing in a room."""
_LOOSEST = 4.0
"""Factor by which the errors of a rigid group may exceed what is usual; reflections and wrong pairs are no thing."""
_MARKED = 500
"""Newest tracks on moving things that are remembered."""


@dataclass(frozen=True, eq=False)
class TwoMotions:
    """Pairs of candidates ``rows`` and features ``columns`` (k,) that stand still, and the rig's motion T (4, 4).

    moving: features (m,) on the thing that moves. is_larger: the pairs that stand still are the larger thing.
    """

    T: FloatArray
    rows: IndexArray
    columns: IndexArray
    moving: IndexArray
    is_larger: bool


class MovingTracks:
    """Tracks that were seen on moving things: they are not used again, also while the thing stands."""

    def __init__(self) -> None:
        self._marked = np.zeros(0, np.int64)

    def mark(self, tracks: np.ndarray) -> None:
        """Remember tracks; 0 is none."""
        self._marked = np.union1d(self._marked, tracks[tracks > 0])[-_MARKED:]

    def marks(self, tracks: np.ndarray) -> np.ndarray:
        """Mask (n,) of the tracks that are marked."""
        return np.isin(tracks, self._marked) if len(self._marked) else np.zeros(len(tracks), bool)


def two_motions(
    candidates: Candidates,
    frame: Frame,
    pairs: tuple[IndexArray, IndexArray],
    T_rig_optical: FloatArray,
    rng: np.random.Generator,
    gate: float,
    least: int,
    variance_scale: FloatArray,
    initial: FloatArray,
) -> TwoMotions | None:
    """The two motions of followed pairs, ``least`` at least of each; None where there is one only.

    ``variance_scale`` (3,): by what factors the pairs' errors usually exceed their claimed variances; ``initial``: the
    motion expected.
    """
    tight = frame.with_larger_noise(np.minimum(variance_scale, 1.0))
    groups: list[tuple[MotionGuess, IndexArray, IndexArray]] = []
    rows, columns = pairs
    for first in (initial, None):
        if len(rows) < least:
            return None
        places = candidates.places(rows), tight.places(columns)
        found = guess_motion(*places, T_rig_optical, rng, _HYPOTHESES, gate, first)
        if found is None or found.inliers.sum() < least or found.variance_scale.max() > _LOOSEST:
            return None
        groups.append((found, rows[found.inliers], columns[found.inliers]))
        rows, columns = rows[~found.inliers], columns[~found.inliers]
    (a, *_), (b, *_) = groups
    difference = boxminus(a.T, b.T)
    if float(difference @ np.linalg.solve(a.covariance + b.covariance, difference)) < _DIFFERENT:
        return None
    sizes = [_size(candidates.points[own]) for _, own, _ in groups]
    if min(sizes) > _SMALL * max(sizes):
        return None
    room = int(np.argmax([size * len(own) for size, (_, own, _) in zip(sizes, groups, strict=True)]))
    (motion, rows, columns), (_, _, moving) = groups[room], groups[1 - room]
    return TwoMotions(motion.T, rows, columns, moving, sizes[room] == max(sizes))


def _size(points: FloatArray) -> float:
    """Root mean square distance (m) of points (n, 3) from their centre."""
    return float(np.sqrt(np.var(points, axis=0).sum()))
