"""A problem that grows against the whole problem solved at once: optimum, covariances, and what must stay valid."""

from __future__ import annotations

import numpy as np
import pytest

from sjsam_node import kernels
from sjsam_node.growing_problem import GrowingProblem
from sjsam_node.joining import JoiningProblem
from sjsam_node.problem import LocalMap, State, flatten
from slam_core.geometry import so3_exp, so3_log
from slam_core.least_squares import LevenbergMarquardtConfig

TOLERANCE = LevenbergMarquardtConfig(30, 1e-12)


def walk(
    rng: np.random.Generator, count: int = 24, rounds: float = 2.0, landmarks: int = 40
) -> tuple[list[LocalMap], State]:
    """Rounds on a circle among landmarks, each local map of those nearby; and the true state."""
    angle = np.linspace(0.0, 2.0 * np.pi * rounds, count + 1)
    R = so3_exp(np.stack([0.05 * np.sin(angle), 0.05 * np.cos(angle), angle % (2 * np.pi)], axis=1))[:, :3, :3]
    t = np.stack([5 * np.sin(angle), 5 - 5 * np.cos(angle), 0.2 * np.sin(2 * angle)], axis=1)
    points = np.column_stack(
        [rng.uniform(-7, 7, landmarks), rng.uniform(-2, 12, landmarks), rng.normal(0, 1, landmarks)]
    )
    maps = []
    for k in range(count):
        seen = np.sort(np.argsort(np.linalg.norm(points - t[k], axis=1))[:6])
        turn = so3_log(R[k].T @ R[k + 1])
        mean = np.concatenate([R[k].T @ (t[k + 1] - t[k]), turn, ((points[seen] - t[k]) @ R[k]).ravel()])
        root = rng.normal(size=(len(mean),) * 2)
        information = 3e4 * (root @ root.T / len(mean) + np.eye(len(mean)))
        noise = np.linalg.cholesky(np.linalg.inv(information)) @ rng.normal(size=len(mean))
        maps.append(LocalMap(k, np.array([k + 1]), seen, mean + noise, information))
    return maps, State(np.ascontiguousarray(R), t, points)


def optimum(maps: list[LocalMap], start: State) -> tuple[JoiningProblem, State]:
    problem = JoiningProblem(flatten(maps), start, np.array([0]), kernels.TANGENT)
    return problem, problem.optimize(start, LevenbergMarquardtConfig(relative_tolerance=1e-14))[0]


def grown(maps: list[LocalMap], state: State, problem: GrowingProblem, first: int = 0) -> State:
    """One local map after the other, each new pose and landmark where the map puts it."""
    for k in range(first, len(maps)):
        problem.last = k + 1, maps[k].landmarks
        result, _ = problem.update(placed(maps, state, k), {k: maps[k]}, TOLERANCE)
        assert result.converged
        state = problem.state
    return state


def placed(maps: list[LocalMap], state: State, k: int) -> State:
    """The state with what local map ``k`` sees first where that map puts it."""
    m, known = maps[k], {int(i) for earlier in maps[:k] for i in earlier.landmarks}
    R, t, points = (a.copy() for a in (state.rotations, state.translations, state.landmarks))
    R[k + 1], t[k + 1] = R[k] @ so3_exp(m.mean[3:6])[:3, :3], R[k] @ m.mean[:3] + t[k]
    for i, mean in zip(m.landmarks.tolist(), m.mean[6:].reshape(-1, 3), strict=True):
        if i not in known:
            points[i] = R[k] @ mean + t[k]
    return State(R, t, points)


def assert_solved(problem: GrowingProblem, maps: list[LocalMap]) -> None:
    whole, best = optimum(maps, problem.state)
    seen = np.unique(np.concatenate([m.landmarks for m in maps]))
    poses = len(maps) + 1
    assert problem.cost == pytest.approx(whole.cost(best), rel=1e-9)
    assert np.abs(problem.state.translations[:poses] - best.translations[:poses]).max() < 1e-6
    assert np.abs(problem.state.landmarks[seen] - best.landmarks[seen]).max() < 1e-6
    assert problem.redundancy == whole.rows - whole.layout.pattern.n


def test_each_update_ends_at_the_optimum_of_the_whole_problem(rng: np.random.Generator) -> None:
    maps, state = walk(rng)
    problem = GrowingProblem(0, 0.02)
    for k in range(1, len(maps) + 1):
        state = grown(maps[:k], state, problem, k - 1)
        assert_solved(problem, maps[:k])


def test_covariances_are_those_of_the_whole_problem_where_it_was_linearised(rng: np.random.Generator) -> None:
    maps, state = walk(rng)
    problem = GrowingProblem(0, 0.0)
    grown(maps, state, problem)
    whole, _ = optimum(maps, problem.state)
    chosen = np.array([3, 24, 0, 12])
    expected = whole.columns(problem.state, chosen)
    assert np.allclose(problem.covariance(chosen), expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_a_local_map_can_be_replaced_and_put_back(rng: np.random.Generator) -> None:
    maps, state = walk(rng)
    problem = GrowingProblem(0, 0.02)
    grown(maps, state, problem)
    m = maps[7]
    fewer = LocalMap(
        m.reference, m.poses, m.landmarks[:3], m.mean[:15], np.linalg.inv(np.linalg.inv(m.information)[:15, :15])
    )
    for version in (fewer, m):
        result, moved = problem.update(problem.state, {7: version}, TOLERANCE)
        assert result.converged
        assert 7 in moved
        assert_solved(problem, [*maps[:7], version, *maps[8:]])


def test_a_copy_stays_as_it_is_and_can_go_on_instead(rng: np.random.Generator) -> None:
    maps, state = walk(rng)
    problem = GrowingProblem(0, 0.02)
    state = grown(maps[:14], state, problem)
    kept = problem.copy()
    grown(maps, state, problem, 14)
    assert_solved(kept, maps[:14])
    grown(maps, kept.state, kept, 14)
    assert_solved(kept, maps)


def test_what_is_far_from_the_change_is_not_eliminated_anew(rng: np.random.Generator) -> None:
    maps, state = walk(rng, 40, 0.7, 300)
    problem = GrowingProblem(0, 0.02)
    state = grown(maps[:-1], state, problem)
    cliques = problem._tree._alive.data.copy()
    result, moved = problem.update(placed(maps, state, 39), {39: maps[39]}, TOLERANCE)
    assert result.converged
    assert 39 in moved
    assert problem._tree._alive.data[: len(cliques)][cliques].mean() > 0.6


def test_a_problem_that_hangs_on_nothing_says_so(rng: np.random.Generator) -> None:
    maps, state = walk(rng)
    problem = GrowingProblem(0, 0.02)
    result, _ = problem.update(state, {0: maps[0], 5: maps[5]}, TOLERANCE)
    assert not result.converged
    assert "singular" in result.reason
