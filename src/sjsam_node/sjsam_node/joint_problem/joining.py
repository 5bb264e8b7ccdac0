# SPDX-License-Identifier: Apache-2.0
"""Joining local maps by sparse least squares: the whole of chapter 7 as one nonlinear problem.

    problem = JoiningProblem(flatten(maps), state, fixed, model)
    state, result = problem.optimize(state)
    marginals = problem.marginals(state)

Every local map enters with its full information matrix, as one factor ("joint rows"); the thesis's
rows, each landmark with its own 3x3, are the same maps through :func:`sjsam_node.joint_problem.problem.block_rows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.layout import Layout, make_layout
from sjsam_node.joint_problem.problem import FlatMaps, JoiningState, LocalMap
from slam_core.estimation.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.geometry import FloatArray
from slam_core.linear_algebra.block_pattern import IntArray
from slam_core.linear_algebra.multifrontal import InversePanels
from slam_core.linear_algebra.sparse_cholesky import Entries, SparseCholesky

_NO_DAMPING = 1e-6
"""Relative damping below which a factor is that of the normal equations themselves."""


class JoiningProblem:
    """Least squares over the poses and landmarks of local maps; implements ``LeastSquaresProblem``.

    Parameters
    ----------
    maps
        The local maps.
    state
        Any state of the right size.
    fixed
        Poses that define the frame, (k,).
    model
        ``kernels.PLANAR``, ``TANGENT`` or ``EULER``.
    backend
        Of ``slam_core.linear_algebra.sparse_cholesky``.
    last
        Nodes to eliminate last (see :func:`~sjsam_node.joint_problem.layout.make_layout`).
    constant
        What the local maps cost beyond their residuals and pulls.
    """

    def __init__(
        self,
        maps: FlatMaps,
        state: JoiningState,
        fixed: IntArray,
        model: int,
        backend: str = "auto",
        last: IntArray | None = None,
        constant: float = 0.0,
    ) -> None:
        self.maps, self.model, self.fixed, self._constant = maps, model, fixed, constant
        self.rows = int(maps.mean_ptr[-1])
        dimension = state.translations.shape[1]
        self.layout: Layout = make_layout(maps, len(state.translations), len(state.landmarks), fixed, dimension, last)
        self.factor = SparseCholesky(self.layout.pattern, backend)
        self._sizes = state.model_dimensions
        pattern = self.layout.pattern
        self._values, self._gradient = np.zeros(int(pattern.value_ptr[-1])), np.zeros(pattern.n)
        self._factorized: JoiningState | None = None
        self._damping = np.inf

    @property
    def backend(self) -> str:
        """The solver that runs."""
        return self.factor.backend

    def cost(self, state: JoiningState) -> float:
        """chi2: sum over the local maps of ``r^T information r + 2 pull^T r``, and the constant."""
        return self._constant + float(kernels.joint_cost(self.model, self.maps, *_arrays(state)))

    def linearize(self, state: JoiningState) -> FloatArray:
        """Normal equations at ``state``."""
        self._values[:] = 0.0
        self._gradient[:] = 0.0
        kernels.joint_linearize(
            self.model, self.maps, *_arrays(state), self.layout.scatter, self._values, self._gradient
        )
        return self._gradient.copy()

    def solve(self, damping: float) -> FloatArray | None:
        """Damped step, or None where the matrix is not positive definite."""
        self._factorized, self._damping = None, np.inf
        diagonal = self.layout.pattern.diagonal
        undamped = self._values[diagonal]
        self._values[diagonal] = (1.0 + damping) * undamped
        is_positive = self.factor.factorize(self._values)
        self._values[diagonal] = undamped
        if not is_positive:
            return None
        self._damping = damping
        return self.factor.solve(-self._gradient)

    def gradient(self, state: JoiningState) -> FloatArray:
        """Gradient alone at ``state``."""
        self._gradient[:] = 0.0
        kernels.joint_gradient(self.model, self.maps, *_arrays(state), self.layout.scatter, self._gradient)
        return self._gradient.copy()

    def resolve(self, gradient: FloatArray) -> FloatArray:
        """Step for this gradient with the last factor."""
        return self.factor.solve(-gradient)

    def retract(self, state: JoiningState, step: FloatArray) -> JoiningState:
        """The state moved by ``step``."""
        return state.retract(self.layout.pose_offset, self.layout.landmark_offset, step)

    def optimize(
        self, state: JoiningState, config: LevenbergMarquardtConfig | None = None, *, keep_factor: bool = False
    ) -> tuple[JoiningState, LeastSquaresResult]:
        """The optimum reached from ``state``.

        ``keep_factor``: its covariances are to be those of the last factor, which is linearised where the last step
        started, without the cost of another one.
        """
        state, result = levenberg_marquardt(self, state, config)
        if keep_factor and self._damping <= _NO_DAMPING:
            self._factorized = state
        return state, result

    def columns(self, state: JoiningState, poses: IntArray) -> FloatArray:
        """Joint covariance of a few poses, linearised at ``state``."""
        self._factorize_at(state)
        return solved_covariance(self.factor, self.scalars(poses, np.empty(0, dtype=np.int64)))

    def scalars(self, poses: IntArray, landmarks: IntArray) -> IntArray:
        """Scalar unknowns of poses and landmarks, in order; -1 for fixed ones."""
        return variable_scalars(self.layout, self._sizes, poses, landmarks)

    def marginal_information(self, state: JoiningState, scalars: IntArray) -> FloatArray:
        """Marginal information matrix of the variables to eliminate ``last``, at ``state``."""
        self._factorize_at(state)
        return self.factor.marginal_information(scalars)

    def newton_step(self, state: JoiningState) -> tuple[FloatArray, float]:
        """The step from ``state`` to the optimum of the problem linearised there, and the cost promised for it.

        Raises
        ------
        ValueError
            If the problem does not determine all its variables.
        """
        self._factorize_at(state)
        step = self.factor.solve(-self._gradient)
        return step, self.cost(state) + float(self._gradient @ step)

    def marginals(self, state: JoiningState) -> Marginals:
        """Exact marginal covariances, linearised at ``state``.

        Raises
        ------
        ValueError
            If the problem does not determine all its variables.
        """
        self._factorize_at(state)
        return Marginals(self.layout, state.model_dimensions, self.factor, self.factor.inverse_entries())

    def _factorize_at(self, state: JoiningState) -> None:
        if self._factorized is state:
            return
        self.linearize(state)
        if not self.factor.factorize(self._values):
            raise ValueError("the normal equations are singular: part of the map hangs on nothing")
        self._factorized = state


def map_residual(model: int, m: LocalMap, state: JoiningState) -> FloatArray:
    """Error ``h [-] z`` (m,) of one local map at a state."""
    d = state.translations.shape[1]
    angles = 1 if d == 2 else 3
    residual, jacobians = np.empty(len(m.mean)), np.empty((len(m.poses), angles, angles))
    R, t, points = _arrays(state)
    kernels.local_residual(
        model, R[m.reference], t[m.reference], m.poses, m.landmarks, m.mean, R, t, points, residual, jacobians
    )
    return residual


def joint_errors(model: int, maps: FlatMaps, state: JoiningState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (m,) of local maps at a state, ``information @ residual`` (m,), and the NIS (l,) of each landmark.

    The NIS is against what all other rows of the same map predict: as many degrees of freedom as a landmark has.
    """
    residual, nis = np.empty((2, int(maps.mean_ptr[-1]))), np.empty(int(maps.landmark_ptr[-1]))
    kernels.joint_errors(model, maps, *_arrays(state), residual[0], residual[1], nis)
    return residual[0], residual[1], nis


def _arrays(state: JoiningState) -> tuple[FloatArray, FloatArray, FloatArray]:
    return state.rotations, state.translations, state.landmarks


@dataclass(frozen=True, eq=False)
class Marginals:
    """Exact covariances of the joined map; tangent order of ``slam_core.geometry``, zero for fixed poses."""

    layout: Layout
    dimensions: tuple[int, int]
    factor: SparseCholesky
    entries: Entries

    def scalars(self, poses: Sequence[int] | IntArray, landmarks: Sequence[int] | IntArray) -> IntArray:
        """Scalar unknowns of these poses and landmarks, in order; -1 for what is fixed."""
        return variable_scalars(self.layout, self.dimensions, poses, landmarks)

    def landmark_blocks(self, landmarks: IntArray) -> FloatArray:
        """Covariance (n, d, d) of each of some landmarks."""
        return self._blocks(self.scalars([], landmarks).reshape(-1, self.dimensions[1]))

    def pose_blocks(self, poses: IntArray) -> FloatArray:
        """Covariance (n, k, k) of each of some poses."""
        return self._blocks(self.scalars(poses, []).reshape(-1, self.dimensions[0]))

    def _blocks(self, scalars: IntArray) -> FloatArray:
        """Covariance of each row (n, k) of unknowns; zero for what is fixed."""
        free, size = scalars[:, 0] >= 0, scalars.shape[1]
        out = np.zeros((len(scalars), size, size))
        if isinstance(self.entries, InversePanels):
            out[free] = self.entries.blocks(scalars[free])
        else:
            out[free] = np.array([self.entries.block(s) for s in scalars[free]]).reshape(-1, size, size)
        return out

    def covariance(self, poses: Sequence[int] | IntArray, landmarks: Sequence[int] | IntArray = ()) -> FloatArray:
        """Joint covariance of any poses and landmarks.

        Inside one local map it is read from the factor's pattern (Takahashi); for others from the factor.
        """
        scalars = self.scalars(poses, landmarks)
        free = np.nonzero(scalars >= 0)[0]
        try:
            block = self.entries.block(scalars[free])
        except KeyError:
            return solved_covariance(self.factor, scalars)
        out = np.zeros((len(scalars), len(scalars)))
        out[np.ix_(free, free)] = block
        return out


def solved_covariance(factor: SparseCholesky, scalars: IntArray) -> FloatArray:
    """Covariance of any unknowns from the factor; zero where ``scalars`` is -1 (fixed)."""
    free = np.nonzero(scalars >= 0)[0]
    out = np.zeros((len(scalars), len(scalars)))
    out[np.ix_(free, free)] = factor.inverse_block(scalars[free])
    return out


def variable_scalars(
    layout: Layout, sizes: tuple[int, int], poses: Sequence[int] | IntArray, landmarks: Sequence[int] | IntArray
) -> IntArray:
    """Scalar unknowns of poses and landmarks, in order; -1 for fixed ones. ``sizes`` of a pose and of a landmark."""
    pose_starts = layout.pose_offset[np.asarray(poses, dtype=np.int64)]
    landmark_starts = layout.landmark_offset[np.asarray(landmarks, dtype=np.int64)]
    return np.concatenate([_runs(pose_starts, sizes[0]), _runs(landmark_starts, sizes[1])])


def _runs(starts: IntArray, length: int) -> IntArray:
    runs = np.where(starts[:, None] >= 0, starts[:, None] + np.arange(length), -1)
    return np.asarray(runs.ravel(), dtype=np.int64)
