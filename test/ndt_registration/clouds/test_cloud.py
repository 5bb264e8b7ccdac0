# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.cloud import evened, finite_points, largest_extent


def test_strays_are_left_out_and_an_even_cloud_is_kept(rng: np.random.Generator) -> None:
    wall = np.column_stack([np.full(2000, 2.0), rng.uniform(-1.0, 1.0, (2000, 2))])
    stray = np.array([[1e6, 0.0, 0.0]])
    np.testing.assert_array_equal(evened(np.concatenate([wall, stray])), wall)
    assert evened(wall) is wall


def test_a_crowd_of_points_becomes_their_means(rng: np.random.Generator) -> None:
    wall = np.column_stack([np.full(2000, 2.0), rng.uniform(-1.0, 1.0, (2000, 2))])
    crowd = np.array([0.5, 0.5, 0.005]) + 1e-3 * rng.uniform(-1.0, 1.0, (2000, 3))
    even = evened(np.concatenate([wall, crowd]))
    assert len(even) < 2000
    assert (np.abs(even - crowd.mean(axis=0)).max(axis=1) < 0.01).sum() < 10


def test_the_extent_is_that_of_the_widest_axis(rng: np.random.Generator) -> None:
    points = rng.normal(0.0, [1.0, 5.0, 2.0], (100, 3))
    assert largest_extent(points) == np.ptp(points, axis=0).max()


@pytest.mark.parametrize("dimensions", [2, 3])
def test_single_and_double_precision_give_the_same_finite_points(rng, dimensions):
    cloud = rng.normal(size=(20, 30, dimensions)).astype(np.float32)
    cloud[rng.random((20, 30)) < 0.2, dimensions - 1] = np.nan
    cloud[3, 4, 0] = np.inf
    expected = np.zeros((int(np.isfinite(cloud).all(axis=2).sum()), 3))
    expected[:, :dimensions] = cloud[np.isfinite(cloud).all(axis=2)]
    np.testing.assert_array_equal(finite_points(cloud), expected)
    np.testing.assert_array_equal(finite_points(cloud.astype(np.float64)), expected)
    assert finite_points(cloud).dtype == np.float64
