# SPDX-License-Identifier: Apache-2.0
"""Alignment of point sets: exactness, weights, reflections, outliers, determinism."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam_core.estimation.rigid_alignment import ransac_rigid_transform, umeyama
from slam_core.geometry import boxminus, make_transform, transform_points

TRUTH = make_transform(Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([1.0, -2.0, 0.5]))


def test_umeyama_is_exact_without_noise(rng: np.random.Generator) -> None:
    source = rng.normal(size=(10, 3))
    np.testing.assert_allclose(umeyama(source, transform_points(TRUTH, source)), TRUTH, atol=1e-12)


def test_umeyama_agrees_with_scipy_on_noisy_weighted_points(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    target = transform_points(TRUTH, source) + 0.05 * rng.normal(size=(30, 3))
    w = rng.uniform(0.1, 3.0, 30)
    source_mean, target_mean = (np.average(p, axis=0, weights=w) for p in (source, target))
    rotation, _ = Rotation.align_vectors(target - target_mean, source - source_mean, weights=w)
    T = umeyama(source, target, w)
    np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], target_mean - rotation.apply(source_mean), atol=1e-9)


def test_umeyama_never_mirrors(rng: np.random.Generator) -> None:
    flat = np.column_stack([rng.normal(size=(20, 2)), np.zeros(20)])
    mirrored = rng.normal(size=(20, 3))
    for source, target in ((flat, transform_points(TRUTH, flat)), (mirrored, mirrored * [1, 1, -1])):
        assert np.linalg.det(umeyama(source, target)[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(umeyama(flat, transform_points(TRUTH, flat)), TRUTH, atol=1e-10)


def test_umeyama_of_a_batch_is_each_alone(rng: np.random.Generator) -> None:
    source, target = rng.normal(size=(2, 6, 4, 3))
    batch = umeyama(source, target)
    for k in range(6):
        np.testing.assert_allclose(batch[k], umeyama(source[k], target[k]), atol=1e-12)


def contaminated(rng: np.random.Generator, outliers: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    source = rng.uniform(-3.0, 3.0, (100, 3))
    target = transform_points(TRUTH, source) + 0.005 * rng.normal(size=(100, 3))
    target[:outliers] = rng.uniform(-4.0, 4.0, (outliers, 3))
    return source, target


@pytest.mark.parametrize("outliers", [0, 30, 60])
def test_ransac_survives_outliers(outliers: int, rng: np.random.Generator) -> None:
    source, target = contaminated(rng, outliers)
    result = ransac_rigid_transform(source, target, 0.03, rng)
    assert result.success
    assert result.inliers[outliers:].all()
    assert result.inliers[:outliers].sum() <= 1
    assert np.abs(boxminus(result.T, TRUTH)).max() < 0.01


def test_ransac_says_when_there_is_no_agreement(rng: np.random.Generator) -> None:
    source, target = rng.uniform(-3.0, 3.0, (2, 60, 3))
    result = ransac_rigid_transform(source, target, 0.01, rng)
    assert not result.success
    assert not ransac_rigid_transform(source[:2], target[:2], 0.01, rng).success
    assert not ransac_rigid_transform(source[:0], target[:0], 0.01, rng).success


def test_ransac_is_deterministic_and_takes_one_threshold_per_point() -> None:
    source, target = contaminated(np.random.default_rng(1), 40)
    first, second = (
        ransac_rigid_transform(source, target, np.full(100, 0.03), np.random.default_rng(7)) for _ in range(2)
    )
    np.testing.assert_array_equal(first.T, second.T)
    np.testing.assert_array_equal(first.inliers, second.inliers)
