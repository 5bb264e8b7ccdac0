# SPDX-License-Identifier: Apache-2.0
"""Covariance of the gradient where neighbouring blocks share errors."""

from __future__ import annotations

import numpy as np

from ndt_registration.methods.uncertainty import _sums_of_cubes, gradient_scatter
from slam_core.geometry import FloatArray


def scatters(shared: float) -> tuple[FloatArray, FloatArray]:
    """Diagonals with cubes of four blocks and of one; blocks of a cube share so much of their gradient."""
    rng = np.random.default_rng(2)
    places = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)
    common = rng.normal(size=(4, 4, 4, 6))[tuple((places // 4).T)]
    gradients = rng.normal(size=(len(places), 6)) + shared * common
    return np.diag(gradient_scatter(gradients, places, 4, 0.0)), np.diag(gradient_scatter(gradients, places, 1, 0.0))


def test_shared_errors_count_as_often_as_they_are_shared() -> None:
    wide, single = scatters(1.0)
    assert np.all(wide > 15.0 * single)  # 64 blocks of one error: 64 + 1 over 1 + 1


def test_independent_blocks_are_counted_once() -> None:
    wide, single = scatters(0.0)
    assert np.all(wide >= 0.99 * single)
    assert np.median(wide) < 1.6 * np.median(single)


def test_gradients_are_summed_by_cube_in_the_order_of_the_places() -> None:
    rng = np.random.default_rng(3)
    cubes, gradients = rng.integers(-3, 3, (500, 3)).astype(np.int32), rng.normal(size=(500, 6))
    places, number = np.unique(cubes, axis=0, return_inverse=True)
    expected = [gradients[number.ravel() == k].sum(axis=0) for k in range(len(places))]
    np.testing.assert_allclose(_sums_of_cubes(gradients, cubes), expected, rtol=1e-12, atol=1e-12)
    assert _sums_of_cubes(np.empty((0, 6)), np.empty((0, 3), np.int32)).shape == (0, 6)
