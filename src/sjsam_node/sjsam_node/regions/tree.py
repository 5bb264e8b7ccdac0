# SPDX-License-Identifier: Apache-2.0
"""Joining as a tree of tasks over regions: up the tree eliminations, down the tree means and covariances.

    tree = RegionTree(maps, state, fixed, model, tasks)
    tree.eliminate(state)
    step = tree.step()                             # to the optimum of the problem linearised there
    poses, landmarks = tree.covariances()          # of every pose and landmark

A region of up to :data:`TASK_MAPS` local maps is one task, with all regions inside it; above, every region is one. The
tree depends on the problem alone: the result has the same bytes wherever the tasks run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from sjsam_node.regions.dissection import LEAF_MAPS, MapRegion, Variables, dissect
from sjsam_node.regions.fronts import (
    Front,
    Reduced,
    assembled,
    eliminate,
    joint_covariance,
    linearized,
    substitute,
)
from sjsam_node.regions.tasks import InProcess, Tasks
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers

TASK_MAPS = 96
"""Local maps of a region that is one task, at most."""


@dataclass(frozen=True, eq=False)
class _Piece:
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
class _Eliminated:
    """A region's factor, and those of the regions inside its task; what it leaves for its parent."""

    front: Front
    reduced: Reduced
    children: tuple[_Eliminated, ...] = ()


# -- tasks: pure functions ---------------------------------------------------------------------------------------------


def _eliminate_piece(piece: _Piece, state: JoiningState, damping: float) -> _Eliminated:
    """Eliminate a region and all inside it."""
    return _eliminate_inside(piece, piece.region, state, damping)


def _eliminate_inside(piece: _Piece, region: MapRegion, state: JoiningState, damping: float) -> _Eliminated:
    width = piece.items.width
    children = tuple(_eliminate_inside(piece, child, state, damping) for child in region.children)
    start = pointers(width[region.variables])
    if children:
        places = [_scalars_in(region, child, width) for child in region.children]
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
    return _Eliminated(front, reduced, children)


def _eliminate_above(own: int, size: int, places: tuple[IntArray, ...], *parts: Reduced) -> _Eliminated:
    """Eliminate ``own`` of ``size`` scalars of a region whose children, at their ``places`` in it, are other tasks."""
    information, gradient = assembled(size, list(zip(places, parts, strict=True)))
    front, reduced = eliminate(information, gradient, own)
    return _Eliminated(front, reduced)


def _step_inside(piece: _Piece, eliminated: _Eliminated, separator: FloatArray) -> FloatArray:
    """Step (n,) of all variables inside a task's region, one after the other as the piece has them."""
    start = pointers(piece.items.width)
    out = np.zeros(int(start[-1]))

    def go(region: MapRegion, part: _Eliminated, known: FloatArray) -> None:
        step = np.concatenate([substitute(part.front, known), known])
        out[_scalars(start, piece.items.width, region.variables)] = step
        for child, inside in zip(region.children, part.children, strict=True):
            go(child, inside, step[_scalars_in(region, child, piece.items.width)])

    go(piece.region, eliminated, separator)
    return out


def _step_above(eliminated: _Eliminated, separator: FloatArray) -> FloatArray:
    return np.concatenate([substitute(eliminated.front, separator), separator])


def _blocks_inside(piece: _Piece, eliminated: _Eliminated, separator: FloatArray) -> FloatArray:
    """Covariance of each variable inside a task's region, (v, 6, 6), filled with zeros."""
    width = piece.items.width
    out = np.zeros((len(width), 6, 6))

    def go(region: MapRegion, part: _Eliminated, known: FloatArray) -> None:
        joint = joint_covariance(part.front, known)
        _take_blocks(region.own, width, joint, out)
        for child, inside in zip(region.children, part.children, strict=True):
            at = _scalars_in(region, child, width)
            go(child, inside, joint[np.ix_(at, at)])

    go(piece.region, eliminated, separator)
    return out


def _covariance_above(eliminated: _Eliminated, separator: FloatArray) -> FloatArray:
    return joint_covariance(eliminated.front, separator)


def _own_blocks(width: IntArray, joint: FloatArray) -> FloatArray:
    """Covariance of each of the first variables of a front, (v, 6, 6), filled with zeros; ``width`` (v,) of each."""
    out = np.zeros((len(width), 6, 6))
    _take_blocks(np.arange(len(width)), width, joint, out)
    return out


def _selected(values: FloatArray, at: IntArray) -> FloatArray:
    """A child's separator out of its parent's step (n,) or covariance (n, n)."""
    return values[at] if values.ndim == 1 else values[np.ix_(at, at)]


# -- numbers -----------------------------------------------------------------------------------------------------------


def _scalars(start: IntArray, width: IntArray, variables: IntArray) -> IntArray:
    """Scalars of some variables, one after the other."""
    sizes = width[variables]
    first = np.repeat(start[variables] - pointers(sizes)[:-1], sizes)
    return np.asarray(first + np.arange(int(sizes.sum())))


def _scalars_in(region: MapRegion, child: MapRegion, width: IntArray) -> IntArray:
    """Scalars of a child's separator in its parent's front."""
    variables = region.variables
    order = np.argsort(variables)
    at = order[np.searchsorted(variables, child.separator, sorter=order)]
    return _scalars(pointers(width[variables])[:-1], width[variables], at)


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


def _piece(model: int, region: MapRegion, maps: FlatMaps, every: Variables) -> _Piece:
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
    return _Piece(model, _renumbered(region, region.maps, variables), own, inside, poses, landmarks)


def _renumbered(region: MapRegion, maps: IntArray, variables: IntArray) -> MapRegion:
    own, separator = np.searchsorted(variables, region.own), np.searchsorted(variables, region.separator)
    children = tuple(_renumbered(child, maps, variables) for child in region.children)
    return MapRegion(np.searchsorted(maps, region.maps), own, separator, children)


# -- the tree ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Node:
    """A region above the pieces (``piece`` is -1), or that of a piece; ``below``: nodes of its children."""

    region: MapRegion
    piece: int
    below: tuple[int, ...]


class RegionTree:
    """The tree of a joining problem, and its tasks.

    Parameters
    ----------
    maps
        The local maps.
    state
        A state; where the maps are there decides where regions are cut.
    fixed
        Poses that define the frame, (k,).
    model
        ``kernels.PLANAR``, ``TANGENT`` or ``EULER``.
    tasks
        Where they run.
    leaf_maps, task_maps
        Local maps of a region that is not cut, and of one that is a single task, at most.
    """

    def __init__(
        self,
        maps: FlatMaps,
        state: JoiningState,
        fixed: IntArray,
        model: int,
        tasks: Tasks | None = None,
        leaf_maps: int = LEAF_MAPS,
        task_maps: int = TASK_MAPS,
    ) -> None:
        self._tasks: Tasks = tasks or InProcess()
        self._sizes, poses = state.model_dimensions, len(state.translations)
        self.variables = Variables.of(maps, poses, len(state.landmarks), fixed, self._sizes)
        self.start = pointers(self.variables.width)
        self.root = dissect(self.variables, state.translations[maps.reference], leaf_maps)
        self._nodes: list[_Node] = []
        self._pieces: list[_Piece] = []
        self._add(self.root, maps, model, task_maps)
        self._held = [self._tasks.hold(piece) for piece in self._pieces]
        self._eliminated: list[Any] = []

    def _add(self, region: MapRegion, maps: FlatMaps, model: int, task_maps: int) -> int:
        """Number of the node of a region, after those below it."""
        if len(region.maps) <= task_maps or not region.children:
            self._pieces.append(_piece(model, region, maps, self.variables))
            node = _Node(region, len(self._pieces) - 1, ())
        else:
            node = _Node(region, -1, tuple(self._add(child, maps, model, task_maps) for child in region.children))
        self._nodes.append(node)
        return len(self._nodes) - 1

    @cached_property
    def offsets(self) -> tuple[IntArray, IntArray]:
        """First scalar of each pose and landmark in a step, -1 for what is fixed or in no map."""
        first = np.where(self.variables.width > 0, self.start[:-1], -1)
        return first[: self.variables.poses], first[self.variables.poses :]

    def eliminate(self, state: JoiningState, damping: float = 0.0) -> None:
        """Go up the tree, linearised at ``state``, the diagonal ``1 + damping`` times what it is."""
        submit, width, reduced = self._tasks.submit, self.variables.width, list[Any]()
        self._eliminated = []
        for node in self._nodes:
            if node.piece >= 0:
                state_there = self._pieces[node.piece].state(state)
                done = submit(_eliminate_piece, self._held[node.piece], state_there, damping)
            else:
                own, size = (int(width[v].sum()) for v in (node.region.own, node.region.variables))
                done = submit(_eliminate_above, own, size, self._places(node), *(reduced[k] for k in node.below))
            self._eliminated.append(done)
            reduced.append(submit(attrgetter("reduced"), done))

    def step(self) -> FloatArray:
        """Step (n,) to the optimum of what was linearised, scalars as in :attr:`offsets`.

        Raises
        ------
        NotDetermined
            If the problem does not determine all its variables.
        """
        handles = self._down(_step_inside, _step_above, np.zeros(0))
        out, width = np.zeros(int(self.start[-1])), self.variables.width
        for node, step in zip(self._nodes, self._tasks.gather(handles), strict=True):
            out[_scalars(self.start, width, self._variables_of(node))] = step
        return out

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariance of every pose (P, 3 | 6, 3 | 6) and landmark (L, 2 | 3, 2 | 3), zero for what is fixed.

        Raises
        ------
        NotDetermined
            If the problem does not determine all its variables.
        """
        width, out = self.variables.width, np.zeros((len(self.variables.width), 6, 6))
        handles = self._down(_blocks_inside, _covariance_above, np.zeros((0, 0)))
        for k, node in enumerate(self._nodes):
            if node.piece < 0:
                handles[k] = self._tasks.submit(_own_blocks, width[node.region.own], handles[k])
        for node, blocks in zip(self._nodes, self._tasks.gather(handles), strict=True):
            variables = node.region.own if node.piece < 0 else self._variables_of(node)
            inside = ~np.isin(variables, node.region.separator)
            out[variables[inside]] = blocks[inside]
        poses, (pose, landmark) = self.variables.poses, self._sizes
        return out[:poses, :pose, :pose], out[poses:, :landmark, :landmark]

    def _down(self, inside: Callable[..., Any], above: Callable[..., Any], nothing: FloatArray) -> list[Any]:
        """Handles of what each node's task gives, from the root down: each is told what its parent knows of it."""
        submit, known, out = self._tasks.submit, {len(self._nodes) - 1: nothing}, [None] * len(self._nodes)
        for k in reversed(range(len(self._nodes))):
            node = self._nodes[k]
            if node.piece >= 0:
                out[k] = submit(inside, self._held[node.piece], self._eliminated[k], known.pop(k))
                continue
            out[k] = submit(above, self._eliminated[k], known.pop(k))
            for child, at in zip(node.below, self._places(node), strict=True):
                known[child] = submit(_selected, out[k], at)
        return out

    def _places(self, node: _Node) -> tuple[IntArray, ...]:
        """Scalars of the separators of a node's children in its front."""
        return tuple(_scalars_in(node.region, child, self.variables.width) for child in node.region.children)

    def _variables_of(self, node: _Node) -> IntArray:
        """Variables that a node's task gives results of, in its order."""
        if node.piece < 0:
            return node.region.variables
        piece = self._pieces[node.piece]
        return np.concatenate([piece.poses, self.variables.poses + piece.landmarks])
