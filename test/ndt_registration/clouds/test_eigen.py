# SPDX-License-Identifier: Apache-2.0
"""Eigenvalues in closed form against LAPACK, near equal eigenvalues and flat cells included."""

from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.eigen import LANES, symmetric_eigen3
from slam_core.geometry import FloatArray, so3_exp

SPECTRA = [
    (1e-6, 0.5, 1.0), (1e-9, 1e-3, 1.0), (0.0, 0.3, 0.7), (0.4, 0.4, 1.0), (0.2, 0.9, 0.9), (0.5, 0.5, 0.5),
    (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.3, 0.3 + 1e-7, 1.0), (2e-8, 5e-8, 6e-8),
]  # fmt: skip


def eigen(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Vectors (3, 3) and values (3,) of a matrix in the last lane; the others hold unit matrices times their number."""
    room = np.full((19, LANES), np.nan)
    room[:6] = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])[:, None] * np.arange(LANES)
    room[:6, -1] = A[np.triu_indices(3)]
    symmetric_eigen3(room.ravel(), np.empty((3, 3)), np.empty((3, 3)), np.empty(3))
    np.testing.assert_allclose(room[6:9, :-1], [np.arange(LANES - 1.0)] * 3)
    return room[9:18, -1].reshape(3, 3).T, room[6:9, -1]


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("seed", range(5))
def test_values_are_lapacks_and_vectors_give_the_matrix_back(spectrum: tuple[float, ...], seed: int) -> None:
    R = so3_exp(np.random.default_rng(seed).normal(size=3))
    A = R @ np.diag(spectrum) @ R.T
    A = 0.5 * (A + A.T)
    vectors, values = eigen(A)
    size = max(spectrum)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), rtol=0, atol=1e-13 * size)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(vectors * values @ vectors.T, A, atol=1e-10 * size)


def test_a_diagonal_matrix_and_one_in_the_plane() -> None:
    vectors, values = eigen(np.diag([3.0, 1.0, 2.0]))
    np.testing.assert_allclose(values, [1.0, 2.0, 3.0], atol=1e-15)
    np.testing.assert_allclose(np.abs(vectors), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    flat = np.zeros((3, 3))
    flat[:2, :2] = [[0.02, 0.01], [0.01, 0.09]]
    assert eigen(flat)[1][0] == pytest.approx(0.0, abs=1e-16)  # the kernels tell scans in the plane by it


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_matrices_of_any_size(scale: float, rng: np.random.Generator) -> None:
    A = rng.normal(size=(3, 3))
    A = scale * (A @ A.T)
    vectors, values = eigen(A)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, A, atol=1e-10 * scale)
