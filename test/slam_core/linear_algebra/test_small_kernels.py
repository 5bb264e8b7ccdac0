# SPDX-License-Identifier: Apache-2.0
"""Squares of few numbers in a metric, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.linear_algebra.small_kernels import solved_square


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_square_and_the_determinant_are_those_of_numpy(n: int, rng: np.random.Generator) -> None:
    root, x = rng.normal(size=(n, n)), rng.normal(size=n)
    A = root @ root.T + np.eye(n)
    L, y = A.copy(), x.copy()
    square, log_det = solved_square(L, y)
    assert square == pytest.approx(x @ np.linalg.solve(A, x), rel=1e-12)
    assert log_det == pytest.approx(np.linalg.slogdet(A)[1], rel=1e-10, abs=1e-12)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(A), rtol=1e-12, atol=1e-12)
    assert y @ y == pytest.approx(square)
