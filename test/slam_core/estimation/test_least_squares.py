# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from slam_core.estimation.chi_square import chi_square_bound
from slam_core.estimation.least_squares import (
    LevenbergMarquardtConfig,
    levenberg_marquardt,
    whitening,
)


def test_whitening_makes_the_covariance_one(rng: np.random.Generator) -> None:
    A = rng.normal(size=(5, 5))
    P = A @ A.T + np.eye(5)
    W = whitening(P)
    assert np.allclose(W @ P @ W.T, np.eye(5), atol=1e-12)


def test_whitening_refuses_what_is_no_covariance() -> None:
    with pytest.raises(ValueError, match="not positive definite"):
        whitening(-np.eye(3))


def test_chi_square_bound_agrees_with_scipy() -> None:
    for dof in (1, 3, 6, 300):
        assert chi_square_bound(0.999, dof) == pytest.approx(chi2.ppf(0.999, dof), rel=1e-10)


class Valley:
    """Rosenbrock's valley as two residuals; plain Gauss-Newton leaves it on the first step."""

    def _residual(self, x: np.ndarray) -> np.ndarray:
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def cost(self, state: np.ndarray) -> float:
        return float(self._residual(state) @ self._residual(state))

    def linearize(self, state: np.ndarray) -> np.ndarray:
        J = np.array([[-20.0 * state[0], 10.0], [-1.0, 0.0]])
        self.H, self.g = J.T @ J, J.T @ self._residual(state)
        return self.g

    def solve(self, damping: float) -> np.ndarray:
        return np.linalg.solve(self.H + damping * np.diag(np.diag(self.H)), -self.g)

    def retract(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step


def test_levenberg_marquardt_walks_the_valley_and_never_up() -> None:
    x, result = levenberg_marquardt(Valley(), np.array([-1.2, 1.0]))
    assert np.allclose(x, 1.0, atol=1e-8)
    assert result.converged
    assert result.cost < 1e-15 < result.initial_cost


def test_levenberg_marquardt_says_when_it_was_cut_short() -> None:
    _, result = levenberg_marquardt(Valley(), np.array([-1.2, 1.0]), LevenbergMarquardtConfig(max_iterations=1))
    assert not result.converged
    assert result.reason == "iteration limit"


class Unsolvable(Valley):
    def solve(self, damping: float) -> None:  # type: ignore[override]
        return None


def test_levenberg_marquardt_gives_up_on_a_singular_problem() -> None:
    x, result = levenberg_marquardt(Unsolvable(), np.array([-1.2, 1.0]))
    assert not result.converged
    assert np.array_equal(x, [-1.2, 1.0])


class Reusable(Valley):
    """Says how often it was linearised and how often its factor was used again."""

    def __init__(self) -> None:
        self.linearized = self.reused = 0

    def linearize(self, state: np.ndarray) -> np.ndarray:
        self.linearized += 1
        return super().linearize(state)

    def gradient(self, state: np.ndarray) -> np.ndarray:
        J = np.array([[-20.0 * state[0], 10.0], [-1.0, 0.0], [0.0, 0.0]])
        return np.asarray(J.T @ np.append(self._residual(state), 1.0))

    def resolve(self, gradient: np.ndarray) -> np.ndarray:
        self.reused += 1
        return np.linalg.solve(self.H, -gradient)

    def cost(self, state: np.ndarray) -> float:
        return super().cost(state) + 1.0  # a rest that no step can lower, as measurements have


def test_near_the_optimum_the_last_factor_is_used_again() -> None:
    problem, whole = Reusable(), Valley()
    start = np.array([1.02, 1.03])
    x, result = levenberg_marquardt(problem, start)
    assert result.converged
    assert np.allclose(x, levenberg_marquardt(whole, start)[0], atol=1e-6)
    assert problem.reused >= 2
    assert problem.linearized <= 3


def test_a_factor_that_leads_nowhere_is_not_used_again() -> None:
    class Stale(Reusable):
        def resolve(self, gradient: np.ndarray) -> np.ndarray:
            self.reused += 1
            return 5.0 * super().resolve(gradient)

    problem = Stale()
    x, result = levenberg_marquardt(problem, np.array([1.02, 1.03]))
    assert result.converged
    assert np.allclose(x, 1.0, atol=1e-5)


class Parabola:
    """One residual (x^2 - 1) / 2, or its tangent at 1, beside a rest of a million that no step can lower."""

    def __init__(self, *, linear: bool) -> None:
        self.linear = linear

    def _residual(self, x: np.ndarray) -> np.ndarray:
        return x - 1.0 if self.linear else 0.5 * (x**2 - 1.0)

    def cost(self, state: np.ndarray) -> float:
        return 1e6 + float(self._residual(state) @ self._residual(state))

    def linearize(self, state: np.ndarray) -> np.ndarray:
        self.J = np.ones(1) if self.linear else state
        self.g = self.J * self._residual(state)
        return self.g

    def solve(self, damping: float) -> np.ndarray:
        return -self.g / ((1.0 + damping) * self.J**2)

    def retract(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step


def test_a_step_that_gained_what_it_promised_near_the_optimum_is_the_last() -> None:
    _, result = levenberg_marquardt(Parabola(linear=True), np.array([1.3]))
    assert result.converged
    assert result.iterations == 1


def test_a_step_that_gained_less_than_it_promised_is_not_the_last() -> None:
    x, result = levenberg_marquardt(Parabola(linear=False), np.array([1.3]))
    assert result.converged
    assert result.iterations > 1
    assert abs(x[0] - 1.0) < 1e-3
