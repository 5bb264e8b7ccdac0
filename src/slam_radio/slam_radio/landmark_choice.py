# SPDX-License-Identifier: Apache-2.0
"""The landmarks of a submap that go on the air: those by which others can be tied to it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import Submap

_SHARE_OF_KNOWN = 0.5
"""Largest share of the choice for landmarks that were sent with the submap before: they tie the two together."""
_SHARE_AHEAD = 0.5
"""Largest share for landmarks in front of the end pose, which the next submap probably sees."""
_AHEAD = 1.0
"""Tangent of the half angle in front of the rig that counts as in front."""
_LIKENESS = 0.8
"""Scalar product of descriptors above which another landmark of the submap looks alike."""


def choose_landmarks(submap: Submap, most: int, known: npt.NDArray[np.int64] | None = None) -> npt.NDArray[np.int64]:
    """Rows of the chosen landmarks, in the order of their ids.

    First come landmarks that the receiver has of the submap before (``known``, their ids), then those in front of the
    end pose, which the next submap probably sees, then others; each kind has its share. A landmark is worth more if
    it is certain, was seen often and looks like no other; of each kind they are taken one by one, far from those taken.

    Parameters
    ----------
    submap
        The submap with all its landmarks.
    most
        Number of landmarks that are sent.
    known
        Ids, shape (k,), sent with the agent's previous submap.
    """
    n = len(submap.landmarks)
    if n <= most:
        return np.argsort(submap.landmark_ids)
    value = _values(submap)
    tied = np.zeros(n, dtype=bool) if known is None else np.isin(submap.landmark_ids, known)
    seen_from_end = (submap.landmarks - submap.end_pose[:3, 3]) @ submap.end_pose[:3, :3]
    ahead = np.abs(seen_from_end[:, 1]) < _AHEAD * seen_from_end[:, 0]
    rows: list[int] = []
    for share, of_kind in ((_SHARE_OF_KNOWN, tied), (_SHARE_AHEAD, ahead), (1.0, np.ones(n, dtype=bool))):
        _take_spread(rows, submap.landmarks, np.where(of_kind, value, 0.0), min(int(share * most), most - len(rows)))
    picked = np.array(rows, dtype=np.int64)
    return np.asarray(picked[np.argsort(submap.landmark_ids[picked])])


def _take_spread(rows: list[int], points: FloatArray, value: FloatArray, count: int) -> None:
    """Append up to ``count`` rows of largest value, weighed by their distance from those that are there."""
    spread = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    near = np.full(len(points), max(spread, 1e-9))
    for row in rows:
        near = np.minimum(near, np.linalg.norm(points - points[row], axis=1))
    for _ in range(count):
        best = int(np.argmax(value * near))
        if value[best] * near[best] <= 0.0:
            return
        rows.append(best)
        near = np.minimum(near, np.linalg.norm(points - points[best], axis=1))


def _values(submap: Submap) -> FloatArray:
    """Worth (n,) of each landmark by itself: sightings over uncertainty, less where others look alike."""
    n = len(submap.landmarks)
    variance = np.diag(submap.covariance)[6:].reshape(n, 3).sum(axis=1)
    relative = np.sqrt(variance) / np.maximum(np.linalg.norm(submap.landmarks, axis=1), 0.5)
    likeness = submap.descriptors @ submap.descriptors.T
    alike = (likeness > _LIKENESS).sum(axis=1) - 1
    certain = 1.0 / (1.0 + relative / np.median(relative))
    return np.asarray(certain * np.log2(1.0 + submap.sightings) / (1.0 + alike))
