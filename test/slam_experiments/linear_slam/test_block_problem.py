# SPDX-License-Identifier: Apache-2.0
"""Poses alone, with all landmarks eliminated, against the joint problem with the same rows."""

from __future__ import annotations

import numpy as np
import pytest
from random_joining import MODELS, perturbed, random_problem

from sjsam_node.joint_problem.joining import JoiningProblem
from sjsam_node.joint_problem.problem import block_rows, flatten
from slam_experiments.linear_slam.block_problem import BlockProblem, flatten_rows


@pytest.fixture(params=MODELS.values(), ids=MODELS)
def model(request: pytest.FixtureRequest) -> int:
    return int(request.param)


def test_the_landmark_schur_complement_reaches_the_same_optimum_by_the_same_steps(
    model: int, rng: np.random.Generator
) -> None:
    maps, s = random_problem(model, rng, maps=8, landmarks=12)
    size, d = s.model_dimensions
    uncorrelated = [block_rows(m, size, d) for m in maps]
    whole = JoiningProblem(flatten(uncorrelated), s, np.array([0]), model)
    reduced = BlockProblem(flatten_rows(uncorrelated, size, d), s, np.array([0]), model)
    start = perturbed(whole, s, rng)
    assert reduced.cost(start) == pytest.approx(whole.cost(start), rel=1e-12)
    for damping in (0.0, 0.3):
        whole.linearize(start)
        reduced.linearize(start)
        steps = whole.solve(damping), reduced.solve(damping)
        assert steps[0] is not None
        assert steps[1] is not None
        a, b = whole.retract(start, steps[0]), reduced.retract(start, steps[1])
        assert np.allclose(a.landmarks, b.landmarks, atol=1e-8)
        assert np.allclose(a.translations, b.translations, atol=1e-8)
        assert np.allclose(a.rotations, b.rotations, atol=1e-8)
    assert reduced.optimize(start)[1].cost == pytest.approx(whole.optimize(start)[1].cost, rel=1e-10)
    assert np.allclose(reduced.gradient(start)[: size * 8], reduced.linearize(start)[: size * 8], rtol=1e-9, atol=1e-6)
    assert np.allclose(reduced.columns(start, np.array([3, 7])), whole.columns(start, np.array([3, 7])), rtol=1e-8)


def test_a_step_with_the_last_factor_solves_for_the_new_gradient(model: int, rng: np.random.Generator) -> None:
    maps, s = random_problem(model, rng)
    uncorrelated = [block_rows(m, *s.model_dimensions) for m in maps]
    whole = JoiningProblem(flatten(uncorrelated), s, np.array([0]), model)
    here = perturbed(whole, s, rng)
    reduced = BlockProblem(flatten_rows(uncorrelated, *s.model_dimensions), s, np.array([0]), model)
    for problem in (whole, reduced):
        problem.linearize(s)
        step = problem.solve(0.0)
        assert step is not None
        assert np.allclose(problem.resolve(problem.gradient(s)), step, atol=1e-10)
        gradient = problem.gradient(here)
        assert np.allclose(problem.linearize(here), gradient, rtol=1e-9, atol=1e-6)
