# SPDX-License-Identifier: Apache-2.0
"""Nested dissection (George 1973) of a joining problem: a tree of regions, each a set of local maps.

A *variable* is a pose or a landmark; poses are numbered first. A region's *separator* are its variables that maps
outside know too; its *own* ones are known to nobody outside, and to no single child. A region is cut where few
variables are known on both sides: along directions in space, since submaps share what is near them, and along the order
of the maps. Nothing depends on how many workers there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sjsam_node.joint_problem.problem import FlatMaps
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers

LEAF_MAPS = 6
"""Local maps of a region that is not cut any more, at most."""
_LEAST_SHARE = 0.35
"""Share of a region's maps that each of its halves gets, at least."""


@dataclass(frozen=True, eq=False)
class MapRegion:
    """A region: its maps, own variables, separator, and the two regions that it was cut into, if it was.

    maps (k,), own (o,) and separator (s,) are numbers, ascending.
    """

    maps: IntArray
    own: IntArray
    separator: IntArray
    children: tuple[MapRegion, ...] = ()

    @property
    def variables(self) -> IntArray:
        """Variables of the front in its order: own ones, then the separator."""
        return np.concatenate([self.own, self.separator])

    def regions(self) -> Iterator[MapRegion]:
        """The region and all those inside it, children first."""
        for child in self.children:
            yield from child.regions()
        yield self


@dataclass(frozen=True, eq=False)
class Variables:
    """The variables of a problem: width (V,) in scalars, 0 for those that are fixed, and how many maps know each, (V,).

    item_ptr (maps + 1,) and items: the variables of each map, in the order reference, poses, landmarks.
    """

    poses: int
    width: IntArray
    known: IntArray
    item_ptr: IntArray
    items: IntArray

    @classmethod
    def of(cls, maps: FlatMaps, poses: int, landmarks: int, fixed: IntArray, sizes: tuple[int, int]) -> Variables:
        """The variables of local maps; ``sizes`` of a pose and of a landmark, in scalars."""
        count = len(maps.reference)
        of_poses, of_landmarks = np.diff(maps.pose_ptr), np.diff(maps.landmark_ptr)
        item_ptr = pointers(1 + of_poses + of_landmarks)
        items = np.empty(int(item_ptr[-1]), dtype=np.int64)
        items[item_ptr[:-1]] = maps.reference
        at = np.repeat(item_ptr[:-1] + 1 - maps.pose_ptr[:-1], of_poses) + np.arange(int(maps.pose_ptr[-1]))
        items[at] = maps.poses[: int(maps.pose_ptr[-1])]
        shift = np.repeat(item_ptr[:-1] + 1 + of_poses - maps.landmark_ptr[:-1], of_landmarks)
        items[shift + np.arange(int(maps.landmark_ptr[-1]))] = poses + maps.landmarks[: int(maps.landmark_ptr[-1])]
        owner = np.repeat(np.arange(count), np.diff(item_ptr))
        pairs = np.unique(owner * (poses + landmarks) + items)
        known = np.bincount(pairs % (poses + landmarks), minlength=poses + landmarks)
        width = np.where(known > 0, np.repeat(sizes, [poses, landmarks]), 0)
        width[fixed] = 0
        return cls(poses, width, known, item_ptr, items)

    def of_maps(self, maps: IntArray) -> tuple[IntArray, IntArray]:
        """Free variables (n,) of some maps, and the place of the map that knows each among these."""
        counts = np.diff(self.item_ptr)[maps]
        at = np.repeat(self.item_ptr[maps] - pointers(counts)[:-1], counts) + np.arange(int(counts.sum()))
        items, owner = self.items[at], np.repeat(np.arange(len(maps)), counts)
        free = self.width[items] > 0
        return items[free], owner[free]


def dissect(variables: Variables, places: FloatArray, leaf_maps: int = LEAF_MAPS) -> MapRegion:
    """The tree of regions of all maps; ``places`` (maps, 2 or 3) are where they are, m."""
    return _dissect(variables, places, np.arange(len(places)), leaf_maps)[0]


def _dissect(
    variables: Variables, places: FloatArray, maps: IntArray, leaf_maps: int
) -> tuple[MapRegion, IntArray, IntArray]:
    """A region of some maps, the variables that it has left for its parent, and how many of its maps know each."""
    items, owner = variables.of_maps(maps)
    if len(maps) <= leaf_maps:
        pairs = np.unique(items * len(maps) + owner)
        left, counts = np.unique(pairs // len(maps), return_counts=True)
        children: tuple[MapRegion, ...] = ()
    else:
        halves = _cut(variables, places[maps], items, owner)
        parts = [_dissect(variables, places, maps[half], leaf_maps) for half in halves]
        children = tuple(part[0] for part in parts)
        left, back = np.unique(np.concatenate([part[1] for part in parts]), return_inverse=True)
        counts = np.bincount(back.ravel(), weights=np.concatenate([part[2] for part in parts])).astype(np.int64)
    is_outside = counts < variables.known[left]
    region = MapRegion(maps, left[~is_outside], left[is_outside], children)
    return region, left[is_outside], counts[is_outside]


def _cut(variables: Variables, places: FloatArray, items: IntArray, owner: IntArray) -> tuple[IntArray, IntArray]:
    """Two halves of the maps, each ascending, that share as little as any of the directions finds."""
    count, best = len(places), (np.inf, 0, np.arange(len(places)))
    names, item = np.unique(items, return_inverse=True)
    width = variables.width[names]
    lowest = max(int(_LEAST_SHARE * count), 1)
    highest = count - lowest
    for along in _directions(places):
        order = np.argsort(along, kind="stable")
        rank = np.empty(count, dtype=np.int64)
        rank[order] = np.arange(count)
        first, last = np.full(len(names), count), np.full(len(names), -1)
        np.minimum.at(first, item.ravel(), rank[owner])
        np.maximum.at(last, item.ravel(), rank[owner])
        # A variable is shared by the two sides of all cuts between its first and its last map.
        change = np.bincount(first + 1, width, count + 2) - np.bincount(last + 1, width, count + 2)
        shared = np.cumsum(change)[lowest : highest + 1]
        at = int(np.argmin(shared))
        if shared[at] < best[0]:
            best = float(shared[at]), lowest + at, order
    _, at, order = best
    return np.sort(order[:at]), np.sort(order[at:])


def _directions(places: FloatArray) -> Iterator[FloatArray]:
    """Coordinates (maps,) along which a region may be cut: axes, diagonals of the plane, and the order of the maps."""
    x, y = places[:, 0], places[:, 1]
    yield from (x, y, x + y, x - y)
    if places.shape[1] > 2:
        yield places[:, 2]
    yield np.arange(len(places), dtype=np.float64)
