# SPDX-License-Identifier: Apache-2.0
"""The joining problem against dense algebra: Jacobians, optimum, marginals, both backends, all three models."""

from __future__ import annotations

import numpy as np
import pytest
from random_joining import MODELS, measured_pose, perturbed, random_problem

from sjsam_node.joint_problem import kernels
from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import JoiningState, LocalMap, block_rows, flatten
from slam_core.geometry import boxminus, make_transform, rotation_from_euler, so3_exp
from slam_core.linear_algebra.sparse_cholesky import BACKENDS


def residual(model: int, m: LocalMap, s: JoiningState) -> np.ndarray:
    """NumPy twin of the kernels' residual."""
    R, t = s.rotations[m.reference], s.translations[m.reference]
    size = 3 if model == kernels.PLANAR else 6
    parts = []
    for k, j in enumerate(m.poses):
        h, z = measured_pose(model, R, t, s.rotations[j], s.translations[j]), m.mean[size * k : size * k + size]
        if model == kernels.TANGENT:
            Rh, Rz = R.T @ s.rotations[j], so3_exp(z[3:])
            angle = boxminus(make_transform(Rh, np.zeros(3)), make_transform(Rz, np.zeros(3)))[3:]
            parts.append(np.concatenate([h[:3] - z[:3], angle]))
        else:
            e = h - z
            d = size // 3 * 1 + 1 if size == 3 else 3
            e[d:] = (e[d:] + np.pi) % (2 * np.pi) - np.pi
            parts.append(e)
    parts.append(((s.landmarks[m.landmarks] - t) @ R).ravel() - m.mean[size * len(m.poses) :])
    return np.concatenate(parts)


def cost(model: int, maps: list[LocalMap], s: JoiningState) -> float:
    return float(sum(residual(model, m, s) @ m.information @ residual(model, m, s) for m in maps))


def dense_normal_matrix(model: int, maps: list[LocalMap], problem: JoiningProblem, s: JoiningState) -> np.ndarray:
    """J^T information J by central differences."""
    n, step = problem.layout.pattern.n, 1e-6
    H = np.zeros((n, n))
    for m in maps:
        J = np.zeros((len(m.mean), n))
        for i in range(n):
            e = np.zeros(n)
            e[i] = step
            J[:, i] = (residual(model, m, problem.retract(s, e)) - residual(model, m, problem.retract(s, -e))) / (
                2 * step
            )
        H += J.T @ m.information @ J
    return H


@pytest.fixture(params=list(MODELS))
def model(request: pytest.FixtureRequest) -> int:
    return MODELS[request.param]


def test_cost_gradient_and_normal_matrix_agree_with_differences(model: int, rng: np.random.Generator) -> None:
    maps, s = random_problem(model, rng)
    problem = JoiningProblem(flatten(maps), s, np.array([0]), model)
    for _ in range(3):
        s = perturbed(problem, s, rng)
        assert problem.cost(s) == pytest.approx(cost(model, maps, s), rel=1e-10)
        gradient = problem.linearize(s)
        H = dense_normal_matrix(model, maps, problem, s)
        step = 1e-6
        for i in range(len(gradient)):
            e = np.zeros(len(gradient))
            e[i] = step
            slope = (problem.cost(problem.retract(s, e)) - problem.cost(problem.retract(s, -e))) / (4 * step)
            assert gradient[i] == pytest.approx(slope, rel=1e-4, abs=1e-2)
        solution = problem.solve(0.0)
        assert solution is not None
        assert np.allclose(solution, np.linalg.solve(H, -gradient), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("backend", ["multifrontal", "cholmod", "superlu"])
def test_optimum_and_marginals_are_those_of_dense_algebra(model: int, backend: str, rng: np.random.Generator) -> None:
    maps, s = random_problem(model, rng)
    problem = JoiningProblem(flatten(maps), s, np.array([0]), model, backend)
    assert problem.backend == backend
    optimum, result = problem.optimize(perturbed(problem, s, rng))
    assert result.converged
    gradient = problem.linearize(optimum)
    assert np.abs(gradient).max() < 1e-3 * np.sqrt(result.initial_cost)
    inverse = np.linalg.inv(dense_normal_matrix(model, maps, problem, optimum))
    marginals = problem.marginals(optimum)
    everything = marginals.scalars(range(1, 6), range(7))
    assert np.allclose(marginals.covariance(range(1, 6), range(7)), inverse[np.ix_(everything, everything)], rtol=1e-4)
    fixed = marginals.covariance([0, 3])
    size = fixed.shape[0] // 2
    assert not fixed[:size].any()
    assert np.allclose(fixed[size:, size:], inverse[np.ix_(*[marginals.scalars([3], [])] * 2)], rtol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_marginal_information_is_the_inverse_of_the_marginal_covariance(backend: str, rng: np.random.Generator) -> None:
    maps, s = random_problem(kernels.TANGENT, rng)
    last = np.array([5, 6 + 1, 6 + 4])  # the newest pose and two landmarks
    problem = JoiningProblem(flatten(maps), s, np.array([0]), kernels.TANGENT, backend, last)
    scalars = problem.scalars(np.array([5]), np.array([1, 4]))
    covariance = problem.marginals(s).covariance([5], [1, 4])
    assert np.allclose(np.linalg.inv(problem.marginal_information(s, scalars)), covariance, rtol=1e-8)


def test_block_rows_keep_each_marginal_and_drop_correlations(rng: np.random.Generator) -> None:
    maps, _ = random_problem(kernels.TANGENT, rng)
    full, block = np.linalg.inv(maps[0].information), np.linalg.inv(block_rows(maps[0], 6, 3).information)
    assert np.allclose(block[:6, :6], full[:6, :6])
    assert np.allclose(block[6:9, 6:9], full[6:9, 6:9])
    assert not block[:6, 6:].any()


def test_a_problem_that_hangs_on_nothing_is_refused() -> None:
    loose = LocalMap(0, np.array([1]), np.empty(0, np.int64), np.zeros(6), np.eye(6))
    s = JoiningState(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), np.zeros((0, 3)))
    problem = JoiningProblem(flatten([loose]), s, np.empty(0, np.int64), kernels.TANGENT)
    with pytest.raises(ValueError, match="singular"):
        problem.marginals(s)


@pytest.mark.parametrize("pitch", [1.5, 1.62, -1.7])
def test_an_attitude_measured_beyond_a_pitch_of_90_degrees_is_the_attitude_it_says(
    pitch: float, rng: np.random.Generator
) -> None:
    z = np.array([1.0, 2.0, 3.0, 0.4, pitch, -0.3])
    R = np.stack([np.eye(3), rotation_from_euler(*z[3:])])
    s = JoiningState(R, np.stack([np.zeros(3), z[:3]]), np.empty((0, 3)))
    local = LocalMap(0, np.array([1]), np.empty(0, dtype=np.int64), z, np.diag(rng.uniform(1.0, 100.0, 6)))
    problem = JoiningProblem(flatten([local]), s, np.array([0]), kernels.EULER)
    assert problem.cost(s) < 1e-20
    moved = problem.retract(s, 0.01 * rng.normal(size=6))
    gradient = problem.linearize(moved)
    for i, step in enumerate(1e-6 * np.eye(6)):
        ahead, behind = (problem.cost(problem.retract(moved, sign * step)) for sign in (1.0, -1.0))
        assert gradient[i] == pytest.approx((ahead - behind) / 4e-6, rel=1e-5, abs=1e-5)


def test_a_step_with_the_last_factor_solves_for_the_new_gradient(model: int, rng: np.random.Generator) -> None:
    maps, s = random_problem(model, rng)
    problem = JoiningProblem(flatten(maps), s, np.array([0]), model)
    here = perturbed(problem, s, rng)
    problem.linearize(s)
    step = problem.solve(0.0)
    assert step is not None
    assert np.allclose(problem.resolve(problem.gradient(s)), step, atol=1e-10)
    gradient = problem.gradient(here)
    assert np.allclose(problem.linearize(here), gradient, rtol=1e-9, atol=1e-6)
