# SPDX-License-Identifier: Apache-2.0
"""Nonlinear least squares: whitening and Levenberg-Marquardt over any problem that can linearise itself.

The sparse factors and their marginals are in :mod:`slam_core.linear_algebra.sparse_cholesky`. Costs are plain sums of
squared residuals, ``chi2 = sum r^T r`` (no factor one half), so that they compare with the chi-square distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import scipy.linalg

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray

State = TypeVar("State")

_NEAR = 0.2
"""A factor is used again from where a step promised less than this share of the cost: close to the optimum."""
_REUSE_RATE = 0.25
"""It is used again as long as each step promises less than this share of what the one before did."""
_DOUBT = 4.0
"""Factor by which a step may promise more than the linear model was wrong by at the one before."""


def median(values: FloatArray) -> float:
    """``np.median`` of finite numbers (n,), at least one, without its tests and copies: a fifth of its time."""
    ordered = np.sort(values)
    n = len(ordered)
    return float(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))


def whitening(covariance: FloatArray) -> FloatArray:
    """``W`` with ``W covariance W^T = I`` (lower triangular), so that ``W e`` is a residual of unit variance.

    Raises
    ------
    ValueError
        If ``covariance`` (n, n) is not positive definite.
    """
    try:
        lower = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"covariance {np.shape(covariance)} is not positive definite") from error
    return np.asarray(scipy.linalg.solve_triangular(lower, np.eye(len(lower)), lower=True))


MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over the median of its absolute deviations."""


@dataclass(frozen=True)
class LevenbergMarquardtConfig(Config):
    """Stopping rules and damping."""

    max_iterations: int = parameter(100, "linearisations at most", minimum=1)
    relative_tolerance: float = parameter(
        1e-12, "stop when a step promises to lower the cost by less than this share", minimum=0.0
    )
    initial_damping: float = parameter(
        1e-9, "first damping, relative to the diagonal of the normal matrix", minimum=0.0
    )
    max_damping: float = parameter(1e8, "give up above this damping", minimum=0.0)


class LeastSquaresProblem(Protocol[State]):
    """Interface of a problem to :func:`levenberg_marquardt`."""

    def cost(self, state: State) -> float:
        """Sum of squared whitened residuals at ``state``."""

    def linearize(self, state: State) -> FloatArray:
        """Prepare the normal equations at ``state``; the gradient ``J^T r`` of half the cost, shape (n,)."""

    def solve(self, damping: float) -> FloatArray | None:
        """Step of ``(H + damping diag H) step = -J^T r`` at the last linearisation; None if not positive definite."""

    def retract(self, state: State, step: FloatArray) -> State:
        """``state`` moved by ``step``."""


@runtime_checkable
class ReusableProblem(LeastSquaresProblem[State], Protocol[State]):
    """A problem whose last factor can be used at other states.

    What is left of a step once the factor is there costs a fraction of a new one.
    """

    def gradient(self, state: State) -> FloatArray:
        """``J^T r`` at ``state``, exactly, with the factor left as it is."""

    def resolve(self, gradient: FloatArray) -> FloatArray:
        """Step for this gradient with the last factor."""


@dataclass(frozen=True, eq=False)
class LeastSquaresResult:
    """Cost before and after, linearisations done, whether the tolerance was reached, and why it stopped otherwise."""

    initial_cost: float
    cost: float
    iterations: int
    converged: bool
    reason: str


def levenberg_marquardt(
    problem: LeastSquaresProblem[State], state: State, config: LevenbergMarquardtConfig | None = None
) -> tuple[State, LeastSquaresResult]:
    """Minimise ``problem`` from ``state``: Gauss-Newton where that works, gradient-like steps where it does not.

    A step is taken only if it lowers the cost; the damping follows the ratio of true to promised decrease
    (Nielsen 1999). The Newton decrement ``-g^T step`` tells how far the optimum still is, which is what the tolerance
    is on. Near the optimum steps with the last factor are tried first (simplified Newton).
    """
    config = config or LevenbergMarquardtConfig()
    initial = cost = problem.cost(state)
    damping, growth, decrement = config.initial_damping, 2.0, np.inf
    for iteration in range(1, config.max_iterations + 1):
        reused = _reuse(problem, state, cost, decrement) if decrement < _NEAR * cost else None
        if reused is not None:
            state, cost, decrement = reused
            if decrement <= config.relative_tolerance * max(cost, 1e-9):
                return state, LeastSquaresResult(initial, cost, iteration, True, "")
            continue
        gradient = problem.linearize(state)
        while True:
            step = problem.solve(damping)
            decrement = np.inf if step is None else float(-gradient @ step)
            if step is not None:
                candidate = problem.retract(state, step)
                candidate_cost = problem.cost(candidate)
                if np.isfinite(candidate_cost) and candidate_cost <= cost:
                    break
            if abs(decrement) <= config.relative_tolerance * max(cost, 1e-9):
                return state, LeastSquaresResult(initial, cost, iteration, True, "")
            damping, growth = max(damping, 1e-9) * growth * 2.0, growth * 2.0
            if damping > config.max_damping:
                return state, LeastSquaresResult(initial, cost, iteration, False, "no step lowers the cost")
        gained = cost - candidate_cost
        state, cost = candidate, candidate_cost
        if _is_last(decrement, gained, max(cost, 1e-9), config.relative_tolerance):
            return state, LeastSquaresResult(initial, cost, iteration, True, "")
        ratio = gained / max(decrement, 1e-300)
        damping, growth = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), config.initial_damping), 2.0
    return state, LeastSquaresResult(initial, cost, config.max_iterations, False, "iteration limit")


def _is_last(decrement: float, gained: float, cost: float, tolerance: float) -> bool:
    """True if nothing worth a step is left: the step just taken promised as little, or the next one would.

    Newton's steps promise about the square of what the one before did, as a share of the cost, and what the linear
    model got wrong about a step is what the next can gain.
    """
    if decrement <= tolerance * cost:
        return True
    return decrement <= np.sqrt(tolerance) * cost and _DOUBT * abs(decrement - gained) <= tolerance * cost


def _reuse(
    problem: LeastSquaresProblem[State], state: State, cost: float, last_decrement: float
) -> tuple[State, float, float] | None:
    """State, cost and decrement after a step with the last factor; None where that is no quick way any more."""
    if not isinstance(problem, ReusableProblem):
        return None
    gradient = problem.gradient(state)
    step = problem.resolve(gradient)
    decrement = float(-gradient @ step)
    if not decrement <= _REUSE_RATE * last_decrement:
        return None
    candidate = problem.retract(state, step)
    candidate_cost = problem.cost(candidate)
    return (candidate, candidate_cost, decrement) if candidate_cost <= cost else None
