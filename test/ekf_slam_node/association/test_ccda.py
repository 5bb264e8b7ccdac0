# SPDX-License-Identifier: Apache-2.0
"""Combined constraint data association: the largest set of pairs that agree two by two."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from ekf_slam_node.association.ccda import ccda, distance_variances, equal_distances


def all_pairs(landmarks: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices((len(landmarks), len(measured)))
    return rows.ravel(), columns.ravel()


def associated(landmarks: np.ndarray, measured: np.ndarray, sigma: float) -> np.ndarray:
    """With no idea of the pose: every pair is possible."""
    rows, columns = all_pairs(landmarks, measured)
    noise = np.broadcast_to(sigma**2 * np.eye(landmarks.shape[1]), (len(rows), *2 * landmarks.shape[1:]))
    a, b = landmarks[rows], measured[columns]
    fits = equal_distances((a, distance_variances(a, noise)), (b, distance_variances(b, noise)), 10.0)
    return ccda(rows, columns, np.zeros(len(rows)), fits, len(measured))


@pytest.mark.parametrize("dimension", [2, 3])
def test_nothing_need_be_known_of_the_pose(rng, dimension):
    landmarks = rng.uniform(-5.0, 5.0, (12, dimension))
    R = np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
    seen = np.array([7, 2, 9, 4, 11, 0])
    measured = landmarks[seen] @ R.T + 30.0 + 0.01 * rng.standard_normal((6, dimension))
    strangers = measured.mean(axis=0) + rng.uniform(-5.0, 5.0, (3, dimension))
    found = associated(landmarks, np.vstack([measured, strangers]), 0.01)
    np.testing.assert_array_equal(found[:6], seen)
    assert (found[6:] == -1).all()


def test_the_largest_set_is_that_of_an_exhaustive_search(rng):
    for _ in range(20):
        n = 12
        fits = np.triu(rng.random((n, n)) < 0.6, 1)
        fits |= fits.T
        best = max(
            size
            for size in range(n + 1)
            if any(all(fits[a, b] for a, b in combinations(chosen, 2)) for chosen in combinations(range(n), size))
        )
        found = ccda(np.arange(n), np.arange(n), np.arange(float(n)), fits.copy(), n)
        chosen = np.flatnonzero(found >= 0)
        assert len(chosen) == best
        assert all(fits[a, b] for a, b in combinations(chosen, 2))


def test_landmarks_and_measurements_are_used_once():
    rows, columns = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    found = ccda(rows, columns, np.array([2.0, 1.0, 1.0, 2.0]), np.ones((4, 4), bool), 2)
    assert found.tolist() == [1, 0]


def test_a_search_that_is_cut_short_still_answers(rng):
    n = 60
    fits = np.ones((n, n), bool)
    found = ccda(np.arange(n), np.arange(n), np.arange(float(n)), fits, n, max_nodes=n)
    assert (found >= 0).all()


def test_distances_err_as_their_ends_do_together(rng):
    points = rng.uniform(-3.0, 3.0, (4, 2))
    root = 1e-3 * rng.standard_normal((8, 8))
    joint = root @ root.T
    unit = points[2] - points[1]
    unit /= np.linalg.norm(unit)
    J = np.zeros(8)
    J[2:4], J[4:6] = -unit, unit
    variance = distance_variances(points, joint.reshape(4, 2, 4, 2))
    assert variance[1, 2] == pytest.approx(J @ joint @ J)
    own = np.array([joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(4)])
    alone = unit @ (own[1] + own[2]) @ unit
    assert distance_variances(points, own)[1, 2] == pytest.approx(alone)


def test_a_common_error_leaves_distances_exact():
    points = np.array([[0.0, 0.0], [3.0, 1.0], [-1.0, 2.0]])
    shared = np.tile(np.eye(2), (3, 3)).reshape(3, 2, 3, 2)
    np.testing.assert_allclose(distance_variances(points, shared), 0.0, atol=1e-12)
