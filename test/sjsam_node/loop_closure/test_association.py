# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submap_world import Agent, circle, ring_world, two_views, unit

from sjsam_node.graph.links import Prior
from sjsam_node.loop_closure.association import AssociationConfig, PointSet, match, mutual_best, variance_factor
from sjsam_node.loop_closure.point_sets import at_end
from sjsam_node.smoothing.estimate import MapEstimate
from slam_core.geometry import boxminus, boxplus, invert_transform, transform_points


@pytest.mark.parametrize("method", ["nearest", "mahalanobis", "joint"])
def test_every_method_finds_true_pairs_and_no_others(method: str, rng: np.random.Generator) -> None:
    first, second, T, truth = two_views(rng)
    loose = Prior(boxplus(T, np.full(6, 0.01)), 0.02**2 * np.eye(6))
    found = match(first, second, loose, AssociationConfig(method=method, nearest_gate=0.4))
    true = {tuple(p) for p in truth.tolist()}
    assert {tuple(p) for p in found.pairs.tolist()} <= true
    assert len(found.pairs) >= 22


def test_joint_compatibility_drops_what_disagrees_with_the_rest(rng: np.random.Generator) -> None:
    """Inside every single gate, but against the joint covariance: all points move together, these do not."""
    first, second, T, _ = two_views(rng, sigma=0.01)
    common = 0.3**2 * np.kron(np.ones((25, 25)), np.eye(3))  # the whole map may be shifted
    shifted = PointSet(second.points, second.covariance + common, second.descriptors)
    moved = shifted.points.copy()
    moved[:3] += [0.25, 0.0, 0.0]
    spoiled = replace(shifted, points=moved)
    tight = Prior(T, 1e-6 * np.eye(6))
    single = match(first, spoiled, tight, AssociationConfig(method="mahalanobis"))
    joint = match(first, spoiled, tight, AssociationConfig(method="joint"))
    assert {0, 1, 2} <= set(single.pairs[:, 1].tolist())
    assert not {0, 1, 2} & set(joint.pairs[:, 1].tolist())
    assert len(joint.pairs) >= 20


def test_the_alignment_and_its_covariance_are_consistent() -> None:
    nees = []
    for seed in range(60):
        first, second, T, _ = two_views(np.random.default_rng(seed))
        prior = Prior(T, 1e2 * np.eye(6))
        found = match(first, second, Prior(T, 0.05**2 * np.eye(6)), AssociationConfig(position_noise=0.0))
        assert found.T.shape == prior.T.shape
        e = boxminus(found.T, T)
        nees.append(e @ np.linalg.solve(found.covariance, e))
    # The prior sits at the truth, so that its share makes the error smaller than claimed: near six, not above.
    assert 3.0 < np.mean(nees) < 7.0


def test_different_looks_are_never_matched(rng: np.random.Generator) -> None:
    first, second, T, _ = two_views(rng)
    stranger = replace(second, descriptors=unit(rng.normal(size=(25, 128))).astype(np.float32))
    assert len(match(first, stranger, Prior(T, 0.01 * np.eye(6)), AssociationConfig()).pairs) == 0


def test_pairs_are_one_to_one(rng: np.random.Generator) -> None:
    i, j = np.nonzero(np.ones((6, 8), dtype=bool))
    pairs = mutual_best(i, j, rng.random(48))
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) > 0


def test_variance_factor_is_one_for_honest_errors_and_measures_dishonest_ones(rng: np.random.Generator) -> None:
    honest = rng.chisquare(3, 4000)
    assert variance_factor(honest) == pytest.approx(1.0, abs=0.06)
    assert variance_factor(9.0 * honest) == pytest.approx(9.0, rel=0.06)
    assert variance_factor(np.concatenate([honest, np.full(800, 1e4)])) < 1.6


def test_landmarks_seen_from_the_end_have_its_error_too(rng: np.random.Generator) -> None:
    """The covariance is that of central differences of ``end^-1 p``."""
    submap = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.2), rng, "").submaps()[0]
    estimate = MapEstimate()
    estimate.add_submap(submap, None, np.eye(4))

    def seen(error: np.ndarray) -> np.ndarray:
        end = boxplus(submap.end_pose, error[:6])
        return transform_points(invert_transform(end), submap.landmarks + error[6:].reshape(-1, 3)).ravel()

    steps = 1e-6 * np.eye(len(submap.covariance))
    J = np.stack([(seen(e) - seen(-e)) / 2e-6 for e in steps], axis=1)
    points = at_end(estimate.graph.records[0])
    np.testing.assert_allclose(points.points.ravel(), seen(np.zeros(len(J.T))), atol=1e-12)
    expected, some = J @ submap.covariance @ J.T, np.array([3, 7, 1])
    rows = (3 * some[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(points.select(some).covariance, expected[np.ix_(rows, rows)], atol=1e-9)
    np.testing.assert_allclose(points.variances()[5], expected[15:18, 15:18], atol=1e-9)
