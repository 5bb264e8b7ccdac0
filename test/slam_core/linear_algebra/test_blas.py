# SPDX-License-Identifier: Apache-2.0
"""The routines that give the interpreter lock away do what NumPy does."""

import numpy as np
import pytest

from slam_core.linear_algebra import blas


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def fortran(*shape, rng):
    return np.asfortranarray(rng.normal(size=shape))


def test_products_change_the_lower_triangle_only(rng):
    A, B, C = (fortran(7, k, rng=rng) for k in (3, 3, 7))
    expected = C.copy()
    lower = np.tril_indices(7)
    expected[lower] += (-A @ A.T + A @ B.T + B @ A.T)[lower]
    blas.subtract_square(C, A)
    blas.add_product(C, A, B)
    np.testing.assert_allclose(C, expected, atol=1e-13)


def test_the_leading_part_of_a_larger_matrix_is_changed_alone(rng):
    A, room = fortran(7, 3, rng=rng), fortran(9, 9, rng=rng)
    expected = room.copy()
    blas.subtract_square(room[:7, :7], A)
    expected[:7, :7][np.tril_indices(7)] -= (A @ A.T)[np.tril_indices(7)]
    np.testing.assert_allclose(room, expected, atol=1e-13)


@pytest.mark.parametrize("k", [1, 5, 48, 130])
def test_cholesky_factor(rng, k):
    A = fortran(k, k, rng=rng)
    S = np.asfortranarray(A @ A.T + np.eye(k))
    L = S.copy(order="F")
    assert blas.cholesky(L)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(S), atol=1e-12)


@pytest.mark.parametrize("n", [0, 1, 40])
def test_inverse_of_a_covariance(rng, n):
    A = rng.normal(size=(n, n))
    S = A @ A.T + np.eye(n)
    inverse = blas.inverse(S)
    np.testing.assert_allclose(inverse @ S, np.eye(n), atol=1e-11)
    np.testing.assert_array_equal(inverse, inverse.T)


def test_an_indefinite_matrix_has_no_factor():
    indefinite = np.diag([1.0, -1.0])
    with pytest.raises(np.linalg.LinAlgError):
        blas.inverse(indefinite)
    assert not blas.cholesky(np.asfortranarray(indefinite))


@pytest.mark.parametrize(
    "wrong", [np.zeros((3, 2)), np.zeros((3, 2), np.float32, order="F"), np.zeros((6, 2), order="F")[::2]]
)
def test_what_blas_would_misread_is_refused(wrong):
    with pytest.raises(ValueError, match="Fortran order"):
        blas.subtract_square(np.zeros((3, 3), order="F"), wrong)
