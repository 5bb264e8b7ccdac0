# SPDX-License-Identifier: Apache-2.0
"""One component of the map as a joining problem, and the result of solving it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sjsam_node.graph.landmark_sets import no_indices
from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem, joint_errors
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from sjsam_node.smoothing.condensed import CondensedSubmap
from sjsam_node.smoothing.frozen import FrozenSubmaps
from sjsam_node.smoothing.reduction import ReducedMap
from slam_core.geometry import FloatArray, compose_covariance
from slam_core.linear_algebra.block_pattern import IntArray


@dataclass(frozen=True, eq=False)
class ComponentProblem:
    """One component: which nodes, landmarks, records and condensed submaps it is made of, and its optimum so far.

    maps: the reduced submaps, then the condensed ones. observations: those of the reduced submaps' landmarks, (k,).
    dropped: scalar rows of each map that a robust loss left out.
    """

    records: list[int]
    condensed: tuple[CondensedSubmap, ...]
    nodes: IntArray
    landmarks: IntArray
    reduced: list[ReducedMap]
    observations: IntArray
    maps: FlatMaps
    problem: JoiningProblem
    optimum: JoiningState
    dropped: list[IntArray]
    frozen: FrozenSubmaps = field(default_factory=FrozenSubmaps)

    @property
    def size(self) -> int:
        """Number of records, frozen and condensed ones included."""
        return len(self.records) + len(self.frozen) + sum(len(c.records) for c in self.condensed)

    @property
    def redundancy(self) -> int:
        """Rows beyond the unknowns, those inside condensed submaps included."""
        return self.problem.rows - self.problem.layout.pattern.n + sum(c.redundancy for c in self.condensed)

    def moving_with(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        """The reference of a node that was not estimated by itself, T_reference_node and its covariance (6, 6)."""
        if (found := self._in_condensed(node)) is not None:
            return found
        frozen = self.frozen.node(node)
        anchor = None if frozen is None else self._in_condensed(frozen[0])
        if frozen is None or anchor is None:
            return frozen
        covariance = compose_covariance(anchor[1], anchor[2], frozen[1], frozen[2])
        return anchor[0], anchor[1] @ frozen[1], covariance

    def _in_condensed(self, node: int) -> tuple[int, FloatArray, FloatArray] | None:
        nodes, owner = self._inner
        at = int(np.searchsorted(nodes, node))
        if at == len(nodes) or nodes[at] != node:
            return None
        found: CondensedSubmap = self.condensed[owner[at]]
        return found.node(node)

    @cached_property
    def _inner(self) -> tuple[IntArray, IntArray]:
        """Nodes inside condensed submaps, ascending, and which one each is inside."""
        nodes = np.concatenate([no_indices(), *(c.inner for c in self.condensed)])
        order = np.argsort(nodes)
        return nodes[order], np.repeat(np.arange(len(self.condensed)), [len(c.inner) for c in self.condensed])[order]

    def nis(self) -> FloatArray:
        """Squared error (k,) of each of the ``observations`` as the rest of its submap predicts it.

        3 degrees of freedom each.
        """
        return joint_errors(kernels.TANGENT, self.maps.first(len(self.records)), self.optimum)[2]

    def covariance(self, nodes: Sequence[int]) -> FloatArray:
        """Joint covariance (6k, 6k) of nodes that are not inside a condensed submap, from the last factor."""
        return self.problem.columns(self.optimum, np.searchsorted(self.nodes, nodes))


@dataclass(frozen=True, eq=False)
class UpdateResult:
    """chi2 of the component and its redundancy, iterations, whether it converged, and the solver.

    overconfidence: variance factor of what was removed because it contradicted itself.
    """

    cost: float
    redundancy: int
    iterations: int
    converged: bool
    solver: str
    overconfidence: float = 1.0

    @property
    def reduced_chi2(self) -> float:
        """chi2 per degree of freedom."""
        return self.cost / self.redundancy if self.redundancy > 0 else 0.0

    @property
    def variance_factor(self) -> float:
        """Factor by which the errors of the submaps are larger than they claim; never below one.

        Submaps that agree better than they should are not made surer.
        """
        return max(self.overconfidence, self.reduced_chi2)
