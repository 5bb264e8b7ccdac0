# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ndt_registration.methods.ambiguity import ambiguity_reason, spread_of_neighbours
from ndt_registration.methods.search import Candidate
from ndt_registration.registration import register
from slam_core.geometry import FloatArray, boxminus, make_transform

CERTAIN = 1e-6 * np.eye(6)


def at_x(x: float, cost: float) -> Candidate:
    return Candidate(make_transform(np.eye(3), np.array([x, 0.0, 0.0])), cost, 0.0, 0.5, np.eye(6))


@pytest.mark.parametrize(
    ("other", "doubted"),
    [
        pytest.param(at_x(1.0, -0.11), True, id="costs hardly more"),
        pytest.param(at_x(1.0, 0.1), False, id="costs much more"),
        pytest.param(at_x(0.02, -0.12), False, id="the same pose"),
    ],
)
def test_only_a_close_rival_elsewhere_makes_a_doubt(other: Candidate, doubted: bool) -> None:
    reason = ambiguity_reason(at_x(0.0, -0.12), [other], CERTAIN, 2.0)
    assert reason.startswith("ambiguous: a pose 1.00 m and 0.0 deg away") if doubted else reason == ""


def test_a_rival_that_the_covariance_covers_is_none() -> None:
    corridor = np.diag([4.0, *np.full(5, 1e-6)])
    assert ambiguity_reason(at_x(0.0, -0.12), [at_x(1.0, -0.12)], corridor, 2.0) == ""


@pytest.mark.parametrize("step", [0.3, -0.3])
def test_a_row_of_equal_pillars_is_ambiguous_without_a_guess(
    empty_room: Any, at: Callable[..., FloatArray], step: float
) -> None:
    rng = np.random.default_rng(5)
    pillars = np.array([[(4.5, y, 0.0), (4.8, y + 0.2, 30.0)] for y in np.arange(0.5, 39.0, 0.6)])
    room = replace(empty_room(6.0, 40.0, 30.0), boxes=pillars)
    start, truth = at(1.0, 20.1, 15.0), at(0.0, step)  # midway between two pillars, then before either
    source, target = room.scan(start @ truth, rng), room.scan(start, rng)
    searched, guessed = register(source, target), register(source, target, at(0.0, 0.9 * step))
    assert not searched.converged
    assert "ambiguous" in searched.reason
    assert searched.covariance[1, 1] > 1.0
    assert guessed.converged
    assert abs(boxminus(guessed.T_target_source, truth)[1]) < 0.01


def test_a_minimum_next_to_the_answer_widens_the_covariance() -> None:
    near, far, dear = at_x(0.04, -0.11), at_x(1.0, -0.11), at_x(0.05, 0.1)
    spread = spread_of_neighbours([at_x(0.0, -0.12), near, far, dear], 2.0)
    expected = np.zeros((6, 6))
    expected[0, 0] = 0.04**2 / 2
    np.testing.assert_allclose(spread, expected, atol=1e-12)
