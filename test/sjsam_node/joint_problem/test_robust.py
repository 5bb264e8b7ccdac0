# SPDX-License-Identifier: Apache-2.0
"""Joining with a robust loss: what it does to a Gaussian, and that false closures leave no trace."""

from __future__ import annotations

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world

from sjsam_node.graph.links import Link
from sjsam_node.joint_problem.problem import LocalMap
from sjsam_node.joint_problem.robust import (
    LOSSES,
    RobustConfig,
    closing_rows,
    normalized_error,
    predicted,
    weight,
    widened,
)
from sjsam_node.smoothing.estimate import MapEstimate
from sjsam_node.smoothing.solver import EstimatorConfig, SmootherConfig
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import boxminus

ROBUST = [loss for loss in LOSSES if loss != "none"]


@pytest.fixture
def gaussian(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (9, 9) and a residual."""
    root = rng.normal(size=(9, 9))
    return root @ root.T + np.eye(9), rng.normal(size=9)


@pytest.mark.parametrize("loss", ROBUST)
def test_weights_fall_with_the_error(loss: str) -> None:
    weights = [weight(loss, nis, 10.0) for nis in (0.0, 1.0, 10.0, 100.0, 1e6)]
    assert weights[0] == 1.0
    assert weights[1] > 0.9
    assert sorted(weights, reverse=True) == weights
    assert weights[-1] < 0.01


def test_widened_rows_have_a_larger_covariance_and_nothing_else(gaussian: tuple[np.ndarray, np.ndarray]) -> None:
    covariance, _ = gaussian
    information, rows = np.linalg.inv(covariance), np.array([3, 4, 5])
    added = np.zeros((9, 9))
    added[3:6, 3:6] = (1.0 / 0.2 - 1.0) * np.linalg.inv(information[3:6, 3:6])
    assert np.allclose(widened(information, rows, 0.2), np.linalg.inv(covariance + added))
    others = np.setdiff1d(np.arange(9), rows)
    marginal = widened(information, rows, 0.0)
    assert np.allclose(marginal[np.ix_(others, others)], np.linalg.inv(covariance[np.ix_(others, others)]))
    assert np.allclose(marginal[rows], 0.0, atol=1e-12)


def test_errors_are_against_what_the_other_rows_predict(gaussian: tuple[np.ndarray, np.ndarray]) -> None:
    covariance, residual = gaussian
    information, rows, others = np.linalg.inv(covariance), np.array([0, 1]), np.arange(2, 9)
    gain = covariance[np.ix_(rows, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
    innovation = residual[rows] - gain @ residual[others]
    spread = covariance[np.ix_(rows, rows)] - gain @ covariance[np.ix_(others, rows)]
    assert normalized_error(information, residual, rows) == pytest.approx(
        innovation @ np.linalg.solve(spread, innovation)
    )
    assert np.allclose(predicted(information, residual, rows)[rows], gain @ residual[others])


def test_only_what_was_seen_before_closes() -> None:
    def local(reference: int, poses: list[int], landmarks: list[int]) -> LocalMap:
        return LocalMap(reference, np.array(poses), np.array(landmarks, np.int64), np.empty(0), np.empty((0, 0)))

    maps = [local(0, [1], [5, 6]), local(1, [2, 0], [6, 7]), local(3, [2], [5])]
    rows = closing_rows(maps, 3, 2)
    assert rows[0] == []
    assert [r.tolist() for r in rows[1]] == [[3, 4, 5], [6, 7]]
    assert [r.tolist() for r in rows[2]] == [[3, 4]]  # the pose is all that ties the map, not a closure


def ring_map(seed: int, loss: str) -> tuple[MapEstimate, Agent]:
    """One lap and a bit around a ring, linked by the true association."""
    rng = np.random.default_rng(seed)
    agent = Agent(ring_world(4.0, rng), circle(4.0, 1.2), rng)
    estimate = MapEstimate(SmootherConfig(estimator=EstimatorConfig(robust=RobustConfig(loss))))
    for k, submap in enumerate(agent.submaps()):
        estimate.add_submap(submap, estimate.graph.records[-1].end if k else None, np.eye(4))
        for older in range(k):
            _, i, j = np.intersect1d(agent.seen[older], agent.seen[k], return_indices=True)
            if len(i):
                estimate.add_links([link(older, k, np.stack([i, j], axis=1))])
    return estimate, agent


def link(first: int, second: int, pairs: np.ndarray) -> Link:
    return Link(first, second, pairs, np.eye(4), 0.01 * np.eye(6), is_closure=True)


def optimized(seed: int, loss: str, *, spoilt: bool) -> tuple[float, float]:
    """Largest error of a pose in m, and the joint squared normalised error of three poses (18 degrees of freedom)."""
    estimate, agent = ring_map(seed, loss)
    if spoilt:
        estimate.add_links([link(3, 12, np.stack([np.arange(10), np.arange(10)], axis=1))])
    estimate.optimize_full()
    poses = estimate.state.poses
    truth = np.array([agent.true_start(k) for k in range(len(poses))])
    some = [5, 12, 18]
    error = np.concatenate([boxminus(truth[k], poses[k]) for k in some])
    nees = error @ np.linalg.solve(estimate.state.problem(0).covariance(some), error)
    return float(np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max()), float(nees)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_false_link_between_submaps_does_not_bend_the_joined_map(seed: int) -> None:
    """Ten landmarks of two places that have nothing to do with each other are taken for the same."""
    clean, bent = optimized(seed, "none", spoilt=False)[0], optimized(seed, "none", spoilt=True)[0]
    robust, nees = optimized(seed, "cauchy", spoilt=True)
    assert bent > 5.0 * clean
    assert robust < 2.0 * clean  # the true sightings of those landmarks are lost too
    assert nees < chi_square_bound(0.999, 18)
