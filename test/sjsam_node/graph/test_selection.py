# SPDX-License-Identifier: Apache-2.0
"""Few, well spread landmarks tie submaps together, and the same ones tie each to all others."""

from __future__ import annotations

import numpy as np

from sjsam_node.graph.selection import spread_order, variables


def test_the_first_of_the_order_are_spread(rng: np.random.Generator) -> None:
    points = np.concatenate([rng.normal(0.0, 0.01, (50, 3)), np.eye(3), -np.eye(3)])
    rank = spread_order(points)
    assert sorted(rank.tolist()) == list(range(56))
    assert set(np.nonzero(rank < 7)[0].tolist()) >= set(range(50, 56))
    assert len(spread_order(np.empty((0, 3)))) == 0


def test_a_landmark_is_a_variable_only_where_it_ties() -> None:
    """Three submaps of three landmarks each; the third is linked to the second alone, by one landmark of three."""
    pairs = np.array([[0, 3], [1, 4], [2, 5], [3, 6], [4, 7], [5, 8]])
    landmark_of = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2])
    rank = np.array([2, 0, 1, 0, 0, 0, 0, 0, 0])
    found = variables(pairs, np.array([0, 3, 6]), np.array([3, 1]), landmark_of, rank)
    assert found.tolist() == [0, 1, 2, 0, 1, 2, 6, 1, 8]


def test_a_variable_is_named_after_the_oldest_observation_that_ties() -> None:
    landmark_of = np.array([0, 0, 0])
    found = variables(np.array([[0, 1], [1, 2]]), np.array([0, 1, 2]), np.array([0, 1]), landmark_of, np.zeros(3, int))
    assert found.tolist() == [0, 1, 1]
