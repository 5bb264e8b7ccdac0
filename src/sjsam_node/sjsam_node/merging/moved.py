# SPDX-License-Identifier: Apache-2.0
"""Things that stood elsewhere when an earlier map was made: a later map contradicts their landmarks.

Where two submaps of different maps are evidently of one place, what one shows and the other does not is compared by
looks alone. If enough of it agrees on one rigid motion by itself, as few as a closure needs by chance, and that is
another motion than the place's, it is a thing that was moved. The earlier map's landmarks of it are let go, the later
one's stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sjsam_node.graph.links import Prior
from sjsam_node.loop_closure.association import Alignment, PointSet
from sjsam_node.loop_closure.verification import Verifier
from sjsam_node.merging.union import Union
from sjsam_node.thinning import thinned
from slam_core.geometry import transform_points
from slam_core.linear_algebra.block_pattern import IntArray

_LEAST_SHIFT_M = 0.2
"""Distance that a thing has moved at least, m: less may be drift inside the submaps."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Landmarks (n,) of an earlier submap that a later one shows elsewhere, by how much (m), and the two submaps."""

    earlier: int
    later: int
    landmarks: IntArray
    shift: float


def moved_between(
    verifier: Verifier, first: PointSet, second: PointSet, place: Alignment | None, pair: tuple[int, int]
) -> Moved | None:
    """Landmarks of the first submap that the second shows elsewhere; ``place`` is how the two align, None if not."""
    if place is None or not verifier.is_evident(first, second, place):
        return None
    left = np.setdiff1d(np.arange(len(first.points)), place.pairs[:, 0])
    right = np.setdiff1d(np.arange(len(second.points)), place.pairs[:, 1])
    old, new = first.select(left), second.select(right)
    thing = verifier.by_looks(old, new, pair)
    if thing is None or not verifier.is_evident(old, new, thing):
        return None
    points = new.points[thing.pairs[:, 1]]
    shift = float(np.linalg.norm(transform_points(place.T, points) - old.points[thing.pairs[:, 0]], axis=1).mean())
    if shift < _LEAST_SHIFT_M or not verifier.is_against(thing, Prior(place.T, place.covariance), 0.0):
        return None
    return Moved(*pair, left[thing.pairs[:, 0]], shift)


def without(union: Union, moved: Sequence[Moved]) -> Union:
    """All submaps without the landmarks of moved things, and a line for each map that had some."""
    gone: dict[int, set[int]] = {}
    for one in moved:
        gone.setdefault(union.source[one.earlier], set()).update(_names(union, one))
    kept = [
        np.nonzero(~np.isin(names, sorted(gone.get(source, ()))) | (submap.landmark_ids < 0))[0]
        for submap, names, source in zip(union.submaps, union.landmarks, union.source, strict=True)
    ]
    submaps = tuple(thinned(submap, k) for submap, k in zip(union.submaps, kept, strict=True))
    landmarks = tuple(names[k] for names, k in zip(union.landmarks, kept, strict=True))
    return replace(union, submaps=submaps, landmarks=landmarks, notes=(*union.notes, *_notes(union, moved)))


def _names(union: Union, one: Moved) -> list[int]:
    """The landmarks of the earlier map that its submaps know the moved ones as."""
    return [int(name) for name in union.landmarks[one.earlier][one.landmarks]]


def _notes(union: Union, moved: Sequence[Moved]) -> list[str]:
    """A line for each two maps: how much of the earlier one the later one shows elsewhere."""
    of: dict[tuple[int, int], list[Moved]] = {}
    for one in moved:
        of.setdefault((union.source[one.earlier], union.source[one.later]), []).append(one)
    out = []
    for (earlier, later), found in sorted(of.items()):
        count = len({name for one in found for name in _names(union, one)})
        low, high = min(one.shift for one in found), max(one.shift for one in found)
        by = f"{high:.1f}" if high - low < 0.1 else f"{low:.1f} to {high:.1f}"
        agent = union.submaps[found[0].earlier].agent
        whose = f" of {agent}" if agent else ""
        out.append(
            f"{union.names[earlier]}: {count} landmarks{whose} were let go, since {union.names[later]} shows them "
            f"{by} m elsewhere"
        )
    return out
