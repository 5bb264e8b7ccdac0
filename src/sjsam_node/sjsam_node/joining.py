"""Joining local maps by sparse least squares: the whole of chapter 7 as one nonlinear problem.

    problem = JoiningProblem(flatten(maps), state, fixed, model)
    state, result = problem.optimize(state)
    marginals = problem.marginals(state)

Every local map enters with its full information matrix, as one factor ("joint rows"); the thesis's
rows, each landmark with its own 3x3, are the same maps through :func:`sjsam_node.problem.block_rows`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sjsam_node import kernels
from sjsam_node.layout import Layout, make_layout
from sjsam_node.problem import FlatMaps, State
from slam_core.geometry import FloatArray
from slam_core.least_squares import LeastSquaresResult, LevenbergMarquardtConfig, levenberg_marquardt
from slam_core.sparse_cholesky import IntArray, InverseEntries, SparseCholesky


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
        Of ``slam_core.sparse_cholesky``.
    last
        Nodes to eliminate last (see :func:`~sjsam_node.layout.make_layout`).
    """

    def __init__(
        self,
        maps: FlatMaps,
        state: State,
        fixed: IntArray,
        model: int,
        backend: str = "auto",
        last: IntArray | None = None,
    ) -> None:
        self.maps, self.model = maps, model
        dimension = state.translations.shape[1]
        self.layout: Layout = make_layout(maps, len(state.translations), len(state.landmarks), fixed, dimension, last)
        self.factor = SparseCholesky(self.layout.pattern, backend)
        pattern = self.layout.pattern
        self._diagonal = np.nonzero(pattern.indices == pattern.columns)[0]
        self._values = np.zeros(len(pattern.indices))
        self._gradient = np.zeros(pattern.n)

    @property
    def backend(self) -> str:
        """The solver that runs."""
        return self.factor.backend

    def cost(self, state: State) -> float:
        """chi2: sum over the local maps of ``r^T information r``."""
        return float(kernels.joint_cost(self.model, self.maps, *_arrays(state)))

    def linearize(self, state: State) -> FloatArray:
        """Normal equations at ``state``."""
        self._values[:] = 0.0
        self._gradient[:] = 0.0
        kernels.joint_linearize(
            self.model, self.maps, *_arrays(state), self.layout.scatter, self._values, self._gradient
        )
        return self._gradient.copy()

    def solve(self, damping: float) -> FloatArray | None:
        """Damped step, or None where the matrix is not positive definite."""
        values = self._values.copy()
        values[self._diagonal] *= 1.0 + damping
        return self.factor.solve(-self._gradient) if self.factor.factorize(values) else None

    def retract(self, state: State, step: FloatArray) -> State:
        """The state moved by ``step``."""
        return state.retract(self.layout.pose_offset, self.layout.landmark_offset, step)

    def optimize(
        self, state: State, config: LevenbergMarquardtConfig | None = None
    ) -> tuple[State, LeastSquaresResult]:
        """The optimum reached from ``state``."""
        return levenberg_marquardt(self, state, config)

    def marginals(self, state: State) -> Marginals:
        """Exact marginal covariances, linearised at ``state``.

        Raises
        ------
        ValueError
            If the problem does not determine all its variables.
        """
        self.linearize(state)
        if not self.factor.factorize(self._values):
            raise ValueError("the normal equations are singular: part of the map hangs on nothing")
        return Marginals(self.layout, state.model_dimensions, self.factor, self.factor.inverse_entries())


def _arrays(state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    return state.rotations, state.translations, state.landmarks


@dataclass(frozen=True, eq=False)
class Marginals:
    """Exact covariances of the joined map; tangent order of ``slam_core.geometry``, zero for fixed poses."""

    layout: Layout
    dimensions: tuple[int, int]
    factor: SparseCholesky
    entries: InverseEntries

    def scalars(self, poses: IntArray | list[int], landmarks: IntArray | list[int]) -> IntArray:
        """Scalar unknowns of these poses and landmarks, in order; -1 for what is fixed."""
        dp, dl = self.dimensions
        runs = [_run(self.layout.pose_offset[i], dp) for i in poses]
        runs += [_run(self.layout.landmark_offset[i], dl) for i in landmarks]
        return np.concatenate(runs) if runs else np.empty(0, dtype=np.int64)

    def covariance(self, poses: IntArray | list[int], landmarks: IntArray | list[int] = ()) -> FloatArray:  # type: ignore[assignment]
        """Joint covariance of any poses and landmarks.

        Inside one local map it is read from the factor's pattern (Takahashi); for others columns are solved for.
        """
        scalars = self.scalars(poses, landmarks)
        out = np.zeros((len(scalars), len(scalars)))
        free = np.nonzero(scalars >= 0)[0]
        try:
            block = self.entries.block(scalars[free])
        except KeyError:
            block = self._solved(scalars[free])
        out[np.ix_(free, free)] = block
        return out

    def _solved(self, scalars: IntArray) -> FloatArray:
        unit = np.zeros((self.layout.pattern.n, len(scalars)))
        unit[scalars, np.arange(len(scalars))] = 1.0
        block = self.factor.solve(unit)[scalars]
        return np.asarray(0.5 * (block + block.T))


def _run(start: int, length: int) -> IntArray:
    return np.arange(start, start + length) if start >= 0 else np.full(length, -1)
