# SPDX-License-Identifier: Apache-2.0
"""Tasks of a tree of regions: pure functions of a piece of the joining problem, or of a front above the pieces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from sjsam_node.regions.dissection import MapRegion, Variables
from sjsam_node.regions.fronts import (
    Front,
    Reduced,
    assembled,
    eliminate,
    joint_covariance,
    linearized,
    substitute,
)
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers


@dataclass(frozen=True, eq=False)
class RegionPiece:
    """One task's part of the problem.

    region: the region over local numbers of maps and variables; maps: its local maps over the local poses and
    landmarks; items: the local variables; poses (p,) and landmarks (l,): their numbers in the whole problem.
    """

    model: int
    region: MapRegion
    maps: FlatMaps
    items: Variables
    poses: IntArray
    landmarks: IntArray

    def state(self, state: JoiningState) -> JoiningState:
        """The part of the state of the whole problem."""
        landmarks = state.landmarks[self.landmarks]
        return JoiningState(state.rotations[self.poses], state.translations[self.poses], landmarks)

    def rows_of(self, maps: IntArray, scalar: IntArray) -> tuple[IntArray, IntArray]:
        """Places of the rows of each map's own equations among scalars: ``scalar`` (v,) is a variable's first, or -1.

        row_ptr (k + 1,) and rows.
        """
        counts = np.diff(self.items.item_ptr)[maps]
        at = np.repeat(self.items.item_ptr[maps] - pointers(counts)[:-1], counts) + np.arange(int(counts.sum()))
        items, sizes = self.items.items[at], self._sizes[self.items.items[at]]
        first = np.repeat(scalar[items], sizes)
        inside = np.arange(int(sizes.sum())) - np.repeat(pointers(sizes)[:-1], sizes)
        return pointers(sizes)[pointers(counts)], np.where(first >= 0, first + inside, -1)

    @property
    def _sizes(self) -> IntArray:
        """Scalars (v,) of each variable in a map's own equations, fixed ones included."""
        d = 2 if self.model == kernels.PLANAR else 3
        sizes = np.full(len(self.items.width), d, dtype=np.int64)
        sizes[: self.items.poses] = 3 if d == 2 else 6
        return sizes


@dataclass(frozen=True, eq=False)
class Eliminated:
    """A region's factor, and those of the regions inside its task; what it leaves for its parent."""

    front: Front
    reduced: Reduced
    children: tuple[Eliminated, ...] = ()


# -- tasks: pure functions ---------------------------------------------------------------------------------------------


def eliminate_piece(piece: RegionPiece, state: JoiningState, damping: float) -> Eliminated:
    """Eliminate a region and all inside it."""
    return _eliminate_inside(piece, piece.region, state, damping)


def reduce_piece(piece: RegionPiece, state: JoiningState, damping: float) -> Reduced:
    """Eliminate a region and all inside it; only what is left for the parent is returned."""
    return eliminate_piece(piece, state, damping).reduced


def eliminated_again(
    inside: Callable[..., FloatArray], piece: RegionPiece, state: JoiningState, damping: float, separator: FloatArray
) -> FloatArray:
    """Result of ``inside`` for a piece that is eliminated once more."""
    return inside(piece, eliminate_piece(piece, state, damping), separator)


def _eliminate_inside(piece: RegionPiece, region: MapRegion, state: JoiningState, damping: float) -> Eliminated:
    width = piece.items.width
    children = tuple(_eliminate_inside(piece, child, state, damping) for child in region.children)
    start = pointers(width[region.variables])
    if children:
        places = [scalars_in(region, child, width) for child in region.children]
        parts = [(at, child.reduced) for at, child in zip(places, children, strict=True)]
        information, gradient = assembled(int(start[-1]), parts)
    else:
        scalar = np.full(len(width), -1, dtype=np.int64)
        scalar[region.variables] = start[:-1]
        row_ptr, rows = piece.rows_of(region.maps, scalar)
        information, gradient = linearized(
            piece.model, piece.maps, region.maps, state, row_ptr, rows, int(start[-1]), damping
        )
    front, reduced = eliminate(information, gradient, int(width[region.own].sum()))
    return Eliminated(front, reduced, children)


def eliminate_above(own: int, size: int, places: tuple[IntArray, ...], *parts: Reduced) -> Eliminated:
    """Eliminate ``own`` of ``size`` scalars of a region whose children, at their ``places`` in it, are other tasks."""
    information, gradient = assembled(size, list(zip(places, parts, strict=True)))
    front, reduced = eliminate(information, gradient, own)
    return Eliminated(front, reduced)


def step_inside(piece: RegionPiece, eliminated: Eliminated, separator: FloatArray) -> FloatArray:
    """Step (n,) of all variables inside a task's region, one after the other as the piece has them."""
    start = pointers(piece.items.width)
    out = np.zeros(int(start[-1]))

    def go(region: MapRegion, part: Eliminated, known: FloatArray) -> None:
        step = np.concatenate([substitute(part.front, known), known])
        out[scalars(start, piece.items.width, region.variables)] = step
        for child, inside in zip(region.children, part.children, strict=True):
            go(child, inside, step[scalars_in(region, child, piece.items.width)])

    go(piece.region, eliminated, separator)
    return out


def step_above(front: Front, separator: FloatArray) -> FloatArray:
    """Step (n,) of a front above the pieces, own variables and separator."""
    return np.concatenate([substitute(front, separator), separator])


def blocks_inside(piece: RegionPiece, eliminated: Eliminated, separator: FloatArray) -> FloatArray:
    """Covariance of each variable inside a task's region, (v, 6, 6), filled with zeros."""
    width = piece.items.width
    out = np.zeros((len(width), 6, 6))

    def go(region: MapRegion, part: Eliminated, known: FloatArray) -> None:
        joint = joint_covariance(part.front, known)
        _take_blocks(region.own, width, joint, out)
        for child, inside in zip(region.children, part.children, strict=True):
            at = scalars_in(region, child, width)
            go(child, inside, joint[np.ix_(at, at)])

    go(piece.region, eliminated, separator)
    return out


def covariance_above(front: Front, separator: FloatArray) -> FloatArray:
    """Covariance (n, n) of a front above the pieces, own variables and separator."""
    return joint_covariance(front, separator)


def own_blocks(width: IntArray, joint: FloatArray) -> FloatArray:
    """Covariance of each of the first variables of a front, (v, 6, 6), filled with zeros; ``width`` (v,) of each."""
    out = np.zeros((len(width), 6, 6))
    _take_blocks(np.arange(len(width)), width, joint, out)
    return out


def selected(values: FloatArray, at: IntArray) -> FloatArray:
    """A child's separator out of its parent's step (n,) or covariance (n, n)."""
    return values[at] if values.ndim == 1 else values[np.ix_(at, at)]


# -- numbers -----------------------------------------------------------------------------------------------------------


def scalars(start: IntArray, width: IntArray, variables: IntArray) -> IntArray:
    """Scalars of some variables, one after the other."""
    sizes = width[variables]
    first = np.repeat(start[variables] - pointers(sizes)[:-1], sizes)
    return np.asarray(first + np.arange(int(sizes.sum())))


def scalars_in(region: MapRegion, child: MapRegion, width: IntArray) -> IntArray:
    """Scalars of a child's separator in its parent's front."""
    variables = region.variables
    order = np.argsort(variables)
    at = order[np.searchsorted(variables, child.separator, sorter=order)]
    return scalars(pointers(width[variables])[:-1], width[variables], at)


def _take_blocks(variables: IntArray, width: IntArray, joint: FloatArray, out: FloatArray) -> None:
    starts = pointers(width[variables])
    for size in np.unique(width[variables]).tolist():
        chosen = np.nonzero(width[variables] == size)[0]
        rows = starts[chosen][:, None] + np.arange(size)
        out[variables[chosen], :size, :size] = joint[rows[:, :, None], rows[:, None, :]]


def _runs(ptr: IntArray, chosen: IntArray) -> IntArray:
    """Places of the entries of the ``chosen`` runs, one run after the other."""
    counts = np.diff(ptr)[chosen]
    return np.asarray(np.repeat(ptr[chosen] - pointers(counts)[:-1], counts) + np.arange(int(counts.sum())))


def piece_of(model: int, region: MapRegion, maps: FlatMaps, every: Variables) -> RegionPiece:
    """A region with all that its task needs, numbered by itself."""
    poses_at, landmarks_at = _runs(maps.pose_ptr, region.maps), _runs(maps.landmark_ptr, region.maps)
    means, values = _runs(maps.mean_ptr, region.maps), _runs(maps.information_ptr, region.maps)
    poses = np.unique(np.concatenate([maps.reference[region.maps], maps.poses[poses_at]]))
    landmarks = np.unique(maps.landmarks[landmarks_at])
    own = FlatMaps(
        np.searchsorted(poses, maps.reference[region.maps]),
        pointers(np.diff(maps.pose_ptr)[region.maps]), np.searchsorted(poses, maps.poses[poses_at]),
        pointers(np.diff(maps.landmark_ptr)[region.maps]), np.searchsorted(landmarks, maps.landmarks[landmarks_at]),
        pointers(np.diff(maps.mean_ptr)[region.maps]), maps.mean[means],
        pointers(np.diff(maps.information_ptr)[region.maps]), maps.information[values], maps.cost_gradient[means],
    )  # fmt: skip
    variables = np.concatenate([poses, every.poses + landmarks])
    counts = np.diff(every.item_ptr)[region.maps]
    items = np.searchsorted(variables, every.items[_runs(every.item_ptr, region.maps)])
    inside = Variables(len(poses), every.width[variables], every.known[variables], pointers(counts), items)
    return RegionPiece(model, _renumbered(region, region.maps, variables), own, inside, poses, landmarks)


def _renumbered(region: MapRegion, maps: IntArray, variables: IntArray) -> MapRegion:
    own, separator = np.searchsorted(variables, region.own), np.searchsorted(variables, region.separator)
    children = tuple(_renumbered(child, maps, variables) for child in region.children)
    return MapRegion(np.searchsorted(maps, region.maps), own, separator, children)
