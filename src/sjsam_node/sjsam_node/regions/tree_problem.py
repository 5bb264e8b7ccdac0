# SPDX-License-Identifier: Apache-2.0
"""A joining problem whose normal equations are solved by the tree of regions, for ``levenberg_marquardt``."""

from __future__ import annotations

import numpy as np

from sjsam_node.graph.landmark_sets import no_indices
from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.layout import Scatter
from sjsam_node.joint_problem.problem import JoiningState
from sjsam_node.regions.fronts import NotDetermined
from sjsam_node.regions.tasks import Tasks
from sjsam_node.regions.tree import TASK_MAPS, RegionTree
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.geometry import FloatArray


class TreeProblem:
    """A joining problem with its steps from a tree of tasks; implements ``LeastSquaresProblem``.

    Parameters
    ----------
    problem
        The problem; it is only read.
    state
        A state, which decides where regions are cut.
    tasks
        Where they run.
    """

    def __init__(self, problem: JoiningProblem, state: JoiningState, tasks: Tasks) -> None:
        self._problem, self._linearised_at = problem, state
        self.tree = RegionTree(problem.maps, state, problem.fixed, problem.model, tasks)

    def cost(self, state: JoiningState) -> float:
        """chi2 at a state."""
        return self._problem.cost(state)

    def linearize(self, state: JoiningState) -> FloatArray:
        """The gradient at ``state``, at which the next step is linearised."""
        self._linearised_at = state
        tree = self.tree
        first = np.concatenate(tree.offsets)
        items, item_ptr = tree.variables.items, tree.variables.item_ptr
        local = np.arange(len(items)) - np.repeat(item_ptr[:-1], np.diff(item_ptr))
        pose, landmark = state.model_dimensions
        width = np.where(items < tree.variables.poses, pose, landmark)
        gradient = np.zeros(int(tree.start[-1]))
        unused = no_indices()
        scatter = Scatter(
            item_ptr, local, np.zeros_like(items), width, item_ptr, first[items], unused, unused, unused, unused
        )
        arrays = state.rotations, state.translations, state.landmarks
        kernels.joint_gradient(self._problem.model, self._problem.maps, *arrays, scatter, gradient)
        return gradient

    def solve(self, damping: float) -> FloatArray | None:
        """Damped step, or None where the matrix is not positive definite."""
        try:
            self.tree.eliminate(self._linearised_at, damping)
            return self.tree.step()
        except NotDetermined:
            return None

    def retract(self, state: JoiningState, step: FloatArray) -> JoiningState:
        """The state moved by ``step``."""
        return state.retract(*self.tree.offsets, step)


def optimized_by_tree(
    problem: JoiningProblem, state: JoiningState, config: LevenbergMarquardtConfig, tasks: Tasks
) -> tuple[JoiningState, LeastSquaresResult]:
    """The optimum of a problem reached from ``state``; one that is a single task is solved by its own factor."""
    if len(problem.maps.reference) <= TASK_MAPS:
        return problem.optimize(state, config)
    return levenberg_marquardt(TreeProblem(problem, state, tasks), state, config)
