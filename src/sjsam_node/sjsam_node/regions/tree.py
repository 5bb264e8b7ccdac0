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

from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from sjsam_node.regions.dissection import LEAF_MAPS, MapRegion, Variables, dissect
from sjsam_node.regions.pieces import (
    RegionPiece,
    blocks_inside,
    covariance_above,
    eliminate_above,
    eliminate_piece,
    eliminated_again,
    own_blocks,
    piece_of,
    reduce_piece,
    scalars,
    scalars_in,
    selected,
    step_above,
    step_inside,
)
from sjsam_node.regions.tasks import InProcess, Tasks
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray, pointers

TASK_MAPS = 96
"""Local maps of a region that is one task, at most."""
KEPT_MAPS = 20_000
"""Local maps of a problem whose factors are kept, at most, 0.14 MiB each; else tasks eliminate once more."""


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
    leaf_maps, task_maps, kept_maps
        Local maps of a region that is not cut, of one that is a single task, and of a problem whose factors are kept.
        The result has the same bytes whether these are kept.
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
        kept_maps: int = KEPT_MAPS,
    ) -> None:
        self._tasks: Tasks = tasks or InProcess()
        self._sizes, poses = state.model_dimensions, len(state.translations)
        self.variables = Variables.of(maps, poses, len(state.landmarks), fixed, self._sizes)
        self.start = pointers(self.variables.width)
        self.root = dissect(self.variables, state.translations[maps.reference], leaf_maps)
        self._nodes: list[_Node] = []
        self._pieces: list[RegionPiece] = []
        self._add(self.root, maps, model, task_maps)
        self._held = [self._tasks.hold(piece) for piece in self._pieces]
        self._keeps = len(maps.reference) <= kept_maps
        self._factors: list[Any] = []
        self._linearised_at: tuple[JoiningState, float] = state, 0.0

    def _add(self, region: MapRegion, maps: FlatMaps, model: int, task_maps: int) -> int:
        """Number of the node of a region, after those below it."""
        if len(region.maps) <= task_maps or not region.children:
            self._pieces.append(piece_of(model, region, maps, self.variables))
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
        self._factors, self._linearised_at = [], (state, damping)
        for node in self._nodes:
            if node.piece >= 0:
                task = eliminate_piece if self._keeps else reduce_piece
                done = submit(task, self._held[node.piece], self._pieces[node.piece].state(state), damping)
                self._factors.append(done if self._keeps else None)
                reduced.append(submit(attrgetter("reduced"), done) if self._keeps else done)
                continue
            own, size = (int(width[v].sum()) for v in (node.region.own, node.region.variables))
            done = submit(eliminate_above, own, size, self._places(node), *(reduced[k] for k in node.below))
            for k in node.below:
                reduced[k] = None  # nobody else asks for it
            self._factors.append(submit(attrgetter("front"), done))
            reduced.append(submit(attrgetter("reduced"), done))

    def step(self) -> FloatArray:
        """Step (n,) to the optimum of what was linearised, scalars as in :attr:`offsets`.

        Raises
        ------
        NotDetermined
            If the problem does not determine all its variables.
        """
        handles = self._down(step_inside, step_above, np.zeros(0))
        out, width = np.zeros(int(self.start[-1])), self.variables.width
        for node, step in zip(self._nodes, self._tasks.gather(handles), strict=True):
            out[scalars(self.start, width, self._variables_of(node))] = step
        return out

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Covariance of every pose (P, 3 | 6, 3 | 6) and landmark (L, 2 | 3, 2 | 3), zero for what is fixed.

        Raises
        ------
        NotDetermined
            If the problem does not determine all its variables.
        """
        width, out = self.variables.width, np.zeros((len(self.variables.width), 6, 6))
        handles = self._down(
            blocks_inside, covariance_above, np.zeros((0, 0)),
            lambda node, joint: self._tasks.submit(own_blocks, width[node.region.own], joint),
        )  # fmt: skip
        for node, blocks in zip(self._nodes, self._tasks.gather(handles), strict=True):
            variables = node.region.own if node.piece < 0 else self._variables_of(node)
            inside = ~np.isin(variables, node.region.separator)
            out[variables[inside]] = blocks[inside]
        poses, (pose, landmark) = self.variables.poses, self._sizes
        return out[:poses, :pose, :pose], out[poses:, :landmark, :landmark]

    def _down(
        self,
        inside: Callable[..., Any],
        above: Callable[..., Any],
        nothing: FloatArray,
        shortened: Callable[[_Node, Any], Any] = lambda _, handle: handle,
    ) -> list[Any]:
        """Handles of what each node's task gives, from the root down: each is told what its parent knows of it.

        ``shortened`` gives what is kept of a result above the pieces once the node's children have their part.
        """
        submit, known, out = self._tasks.submit, {len(self._nodes) - 1: nothing}, [None] * len(self._nodes)
        for k in reversed(range(len(self._nodes))):
            node = self._nodes[k]
            if node.piece >= 0:
                out[k] = self._down_inside(inside, node.piece, self._factors[k], known.pop(k))
                continue
            result = submit(above, self._factors[k], known.pop(k))
            for child, at in zip(node.below, self._places(node), strict=True):
                known[child] = submit(selected, result, at)
            out[k] = shortened(node, result)
        return out

    def _down_inside(self, inside: Callable[..., Any], number: int, factor: Any, separator: Any) -> Any:
        """Handle of what a piece's task gives, by its factor or, where that was not kept, by a new one."""
        piece = self._held[number]
        if self._keeps:
            return self._tasks.submit(inside, piece, factor, separator)
        state, damping = self._linearised_at
        return self._tasks.submit(
            eliminated_again, inside, piece, self._pieces[number].state(state), damping, separator
        )

    def _places(self, node: _Node) -> tuple[IntArray, ...]:
        """Scalars of the separators of a node's children in its front."""
        return tuple(scalars_in(node.region, child, self.variables.width) for child in node.region.children)

    def _variables_of(self, node: _Node) -> IntArray:
        """Variables that a node's task gives results of, in its order."""
        if node.piece < 0:
            return node.region.variables
        piece = self._pieces[node.piece]
        return np.concatenate([piece.poses, self.variables.poses + piece.landmarks])
