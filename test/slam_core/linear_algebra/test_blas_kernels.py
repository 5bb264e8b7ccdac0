# SPDX-License-Identifier: Apache-2.0
"""BLAS in compiled kernels, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.linear_algebra import blas_kernels

SIZES = [(1, 1), (3, 7), (48, 120), (130, 65)]


@pytest.mark.parametrize(("k", "n"), SIZES)
def test_a_front_is_eliminated_in_place(k: int, n: int, rng: np.random.Generator) -> None:
    root = rng.normal(size=(k + n, k + n + 3))
    S = root @ root.T
    panel = S[:, :k].copy()
    rest = S[k:, k:].copy()
    assert blas_kernels.cholesky(panel[:k])
    blas_kernels.solve_right(panel[:k], panel[k:])
    blas_kernels.subtract_square(panel[k:], rest)
    L = np.linalg.cholesky(S)
    assert np.allclose(np.tril(panel), np.tril(L[:, :k]), rtol=1e-9)
    assert np.allclose(np.tril(rest), np.tril(L[k:, k:] @ L[k:, k:].T), rtol=1e-9)
    # What is above the diagonal is neither read nor written.
    assert np.array_equal(np.triu(panel[:k], 1), np.triu(S[:k, :k], 1))
    assert np.array_equal(np.triu(rest, 1), np.triu(S[k:, k:], 1))


@pytest.mark.parametrize(("k", "n"), [*SIZES, (1, 9), (96, 20)])
def test_an_innovation_is_whitened_in_place(k: int, n: int, rng: np.random.Generator) -> None:
    root, B, y = rng.normal(size=(k, k + 3)), np.asfortranarray(rng.normal(size=(n, k))), rng.normal(size=k)
    S = np.asfortranarray(root @ root.T)
    L, W, whitened = S.copy(order="F"), B.copy(order="F"), y.copy()
    assert blas_kernels.whiten(L, W, whitened)
    expected = np.linalg.cholesky(S)
    np.testing.assert_allclose(np.tril(L), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(W @ expected.T, B, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(expected @ whitened, y, rtol=1e-9, atol=1e-9)
    assert not blas_kernels.whiten(-S, W, whitened)


@pytest.mark.parametrize("spoilt", [0.0, -1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_refused(spoilt: float) -> None:
    S = np.eye(5)
    S[3, 3] = spoilt
    assert not blas_kernels.cholesky(S)


def test_nothing_to_eliminate_is_no_error() -> None:
    nothing, C = np.empty((0, 0)), np.eye(3)
    assert blas_kernels.cholesky(nothing)
    blas_kernels.solve_right(nothing, np.empty((3, 0)))
    blas_kernels.subtract_square(np.empty((3, 0)), C)
    assert np.array_equal(C, np.eye(3))


@pytest.mark.parametrize(("k", "m"), [(150, 3), (5, 0), (0, 3)])
def test_a_covariance_loses_a_square_and_takes_a_product(k: int, m: int, rng: np.random.Generator) -> None:
    """In the lower triangle of the part in use; the rest of the buffer is neither read nor written."""
    n = 120
    P, W = np.asfortranarray(rng.normal(size=(n + 9, n + 9))), np.asfortranarray(rng.normal(size=(n, k)))
    A, B, before = rng.normal(size=(m, n)), rng.normal(size=(m, n)), P.copy()
    blas_kernels.subtract_square_and_add_product(W, A, B, P)
    expected = before[:n, :n] - W @ W.T + A.T @ B + B.T @ A
    np.testing.assert_allclose(np.tril(P[:n, :n]), np.tril(expected), atol=1e-10)
    kept = np.triu(np.ones_like(P), 1).astype(bool)
    kept[n:] = kept[:, n:] = True
    np.testing.assert_array_equal(P[kept], before[kept])
