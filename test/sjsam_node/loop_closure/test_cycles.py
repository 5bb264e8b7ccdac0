# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from submap_world import pose

from sjsam_node.graph.links import Link, Prior
from sjsam_node.loop_closure.cycles import cycles_through
from slam_core.geometry import boxminus, boxplus, invert_transform

TRUE = [pose(*p) for p in ((0.0, 0.0, 0.0), (2.0, 1.0, 0.5), (4.0, -1.0, 2.0), (1.0, 3.0, -1.0), (-2.0, 1.0, 3.0))]
PART = [0, 0, 1, 1, 2]
"""Part of the map that each record is in."""
SURE = np.diag([0.02**2] * 3 + [0.005**2] * 3)


def link(first: int, second: int, off: float = 0.0, covariance: np.ndarray = SURE) -> Link:
    T = boxplus(invert_transform(TRUE[first]) @ TRUE[second], np.array([off, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return Link(first, second, np.zeros((5, 2), dtype=np.int64), T, covariance, is_closure=True)


def hop(first: int, second: int) -> Prior | None:
    if PART[first] != PART[second]:
        return None
    return Prior(invert_transform(TRUE[first]) @ TRUE[second], None if first == second else SURE)


def test_a_second_link_between_two_parts_closes_a_cycle() -> None:
    (cycle,) = cycles_through(link(0, 2), [link(1, 3)], hop)
    assert [k.ends for k in cycle.links] == [(0, 2), (3, 1)]
    np.testing.assert_allclose(cycle.T, np.eye(4), atol=1e-12)
    assert cycle.closes(0.999)


def test_one_link_each_between_three_parts_closes_a_cycle_whatever_their_directions() -> None:
    (cycle,) = (c for c in cycles_through(link(0, 2), [link(4, 3), link(4, 1)], hop) if len(c.links) == 3)
    assert [k.ends for k in cycle.links] == [(0, 2), (3, 4), (4, 1)]
    np.testing.assert_allclose(cycle.T, np.eye(4), atol=1e-12)


def test_links_that_lead_on_and_never_back_make_no_cycle() -> None:
    assert not list(cycles_through(link(0, 2), [link(3, 4)], hop))
    assert not list(cycles_through(link(0, 2), [], hop))
    assert not list(cycles_through(link(0, 2), [link(0, 2, 0.1)], hop))  # the same two records again


def test_a_cycle_with_a_false_link_does_not_close() -> None:
    for off, closes in ((0.05, True), (0.5, False)):
        (cycle,) = cycles_through(link(0, 2, off), [link(1, 3)], hop)
        assert cycle.closes(0.999) == closes


def test_the_covariance_of_a_cycle_is_that_of_its_steps(rng: np.random.Generator) -> None:
    (cycle,) = cycles_through(link(0, 2), [link(1, 3)], hop)
    steps = [link(0, 2).T, hop(2, 3).T, link(1, 3).inverted().T, hop(1, 0).T]
    spread = [SURE, SURE, link(1, 3).inverted().covariance, SURE]
    errors = []
    for _ in range(4000):
        noisy = [boxplus(T, np.linalg.cholesky(P) @ rng.normal(size=6)) for T, P in zip(steps, spread, strict=True)]
        errors.append(boxminus(np.linalg.multi_dot(noisy), np.eye(4)))
    np.testing.assert_allclose(np.cov(np.array(errors).T), cycle.covariance, atol=0.1 * cycle.covariance.max())


def test_the_chance_to_close_is_the_share_of_the_space_that_the_gate_leaves(rng: np.random.Generator) -> None:
    wide = np.diag([0.3**2] * 3 + [0.1**2] * 3)
    (cycle,) = cycles_through(link(0, 2, covariance=wide), [link(1, 3)], hop)
    (sure,) = cycles_through(link(0, 2), [link(1, 3)], hop)
    assert sure.chance(0.999, 5.0) < 0.1 * cycle.chance(0.999, 5.0)
    assert cycle.chance(0.999, 50.0) == pytest.approx(cycle.chance(0.999, 25.0) / 4.0)
    assert cycle.chance(0.999, 1e-3) <= 1.0
    inside = rng.uniform(-5.0, 5.0, (20000, 2)), rng.uniform(-np.pi, np.pi, 20000)
    hits = 0
    for xy, yaw in zip(*inside, strict=True):
        e = np.array([*xy, 0.0, 0.0, 0.0, yaw])
        hits += e @ np.linalg.solve(cycle.covariance, e) < 22.5
    assert hits / 20000 < cycle.chance(0.999, 5.0) < 20.0 * (hits / 20000 + 1e-3)
