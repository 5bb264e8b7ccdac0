# SPDX-License-Identifier: Apache-2.0
"""The compiled kernels of the measurement model and of the covariance against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.filtering import measurement_kernels as kernels
from ekf_slam_node.filtering.covariance import Covariance
from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.models import (
    CORE_DIM,
    Frame,
    back_project,
    observe,
    project,
    project_jacobian,
    rig_points,
)
from feature_world import CAMERA, T_RIG_OPTICAL
from slam_core.geometry import FloatArray, make_transform, skew, so3_exp, so3_left_jacobian

M = 7
ROWS = CORE_DIM + 3 * np.arange(M)


def random_pose(rng: np.random.Generator) -> FloatArray:
    return make_transform(so3_exp(rng.standard_normal(3)), rng.standard_normal(3))


def covariances(rng: np.random.Generator, n: int, size: int) -> FloatArray:
    A = rng.standard_normal((n, size, 2 * size))
    return np.asarray(A @ np.swapaxes(A, 1, 2))


@pytest.fixture
def ekf(rng: np.random.Generator) -> Ekf:
    P = covariances(rng, 1, CORE_DIM + 3 * M)[0]
    ekf = Ekf(rng.standard_normal(6), P, landmarks=rng.standard_normal((M, 3)))
    ekf.T = random_pose(rng)
    return ekf


def test_points_are_seen_as_numpy_has_them(rng: np.random.Generator) -> None:
    T = random_pose(rng)
    camera = T @ T_RIG_OPTICAL
    points = rng.uniform([-2.0, -2.0, 1.0], [2.0, 2.0, 5.0], (30, 3)) @ camera[:3, :3].T + camera[:3, 3]
    points[0] = camera[:3, 3] - camera[:3, 2]  # behind the camera
    seen = observe(T, T_RIG_OPTICAL, points, CAMERA)
    optical = (points - camera[:3, 3]) @ camera[:3, :3]
    J_point = project_jacobian(optical, CAMERA) @ camera[:3, :3].T
    J_pose = np.concatenate([-J_point, J_point @ skew(points - T[:3, 3])], axis=2)
    for value, expected in (
        (seen.z, project(optical, CAMERA)),
        (seen.depth, optical[:, 2]),
        (seen.J_point, J_point),
        (seen.J_pose, J_pose),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9 * np.abs(expected[1:]).max())


def back_project_jacobian(z: FloatArray) -> FloatArray:
    """Derivative (n, 3, 3) of :func:`back_project` (Eq. 6.24)."""
    depth = 1.0 / z[:, 2]
    J = np.zeros((len(z), 3, 3))
    J[:, 0, 0], J[:, 1, 1] = depth / CAMERA.fx, depth / CAMERA.fy
    J[:, :, 2] = -back_project(z, CAMERA) * depth[:, None]
    return J


def test_features_lie_where_numpy_has_them(rng: np.random.Generator) -> None:
    z = rng.uniform([0.0, 0.0, 0.2], [640.0, 480.0, 2.0], (30, 3))
    frame = Frame(
        0, z, rng.uniform(0.1, 1.0, (30, 3)), np.zeros((30, 1)), CAMERA, np.arange(30), np.zeros(30, np.int32)
    )
    points, spread = rig_points(frame, T_RIG_OPTICAL)
    R = T_RIG_OPTICAL[:3, :3]
    J = R @ back_project_jacobian(z)
    np.testing.assert_allclose(points, back_project(z, CAMERA) @ R.T + T_RIG_OPTICAL[:3, 3], rtol=1e-12)
    np.testing.assert_allclose(spread, np.einsum("nij,nj,nkj->nik", J, frame.variance, J), rtol=1e-9, atol=1e-15)


def test_rows_exposed_one_after_the_other_move_points_as_numpy_has_it(rng: np.random.Generator) -> None:
    z = rng.uniform([0.0, 0.0, 0.2], [640.0, 480.0, 2.0], (30, 3))
    turn, shift, readout = rng.standard_normal(3), rng.standard_normal(3), 0.02
    points = back_project(z, CAMERA)
    share = (z[:, 1] - 0.5 * (CAMERA.height - 1)) / CAMERA.height
    expected = share[:, None] * (shift + np.cross(turn, points))
    rates, moved = np.empty((30, 3)), np.empty((30, 3))
    kernels.rolling_rates(z, CAMERA.lens, CAMERA.height, turn, shift, rates)
    kernels.moved_measurements(z, CAMERA.lens, rates, readout, moved)
    np.testing.assert_allclose(rates, expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(moved, project(points + readout * expected, CAMERA), rtol=1e-12)


def test_innovation_covariances(ekf: Ekf, rng: np.random.Generator) -> None:
    """Each observation's own, and the lower triangle of the joint one."""
    J_pose, J_point = rng.standard_normal((M, 3, 6)), rng.standard_normal((M, 3, 3))
    variance, common = rng.uniform(0.1, 1.0, (M, 3)), rng.uniform(0.1, 1.0, 6)
    P = ekf.covariance.dense()
    H = np.zeros((3 * M, len(P)))
    H[:, :6] = J_pose.reshape(-1, 6)
    for k, row in enumerate(ROWS):
        H[3 * k : 3 * k + 3, row : row + 3] = J_point[k]
    B = H[:, :6] * common
    expected = H @ P @ H.T + B @ B.T + np.diag(variance.ravel())
    S = np.zeros((3 * M, 3 * M), order="F")
    kernels.lower_innovation(J_pose, J_point, np.asfortranarray(P @ H.T), ROWS, variance, common**2, S)
    np.testing.assert_allclose(np.tril(S), np.tril(expected), rtol=1e-9, atol=1e-9)

    own = np.zeros((M, 3, 3))
    kernels.add_of_pose(J_pose, P[:6, :6] + np.diag(common**2), own)
    kernels.add_of_points(J_point, ekf.covariance.blocks(ROWS), own)
    kernels.mixed_terms(J_pose, J_point, ekf.covariance.head(6), ROWS, own)
    for k in range(M):
        block = expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] - np.diag(variance[k])
        np.testing.assert_allclose(own[k], block, rtol=1e-9, atol=1e-9)


def test_squared_lengths_of_innovations(rng: np.random.Generator) -> None:
    innovation, S = rng.standard_normal((M, 3)), covariances(rng, M, 3)
    S[0, 0, 0] = -1.0
    out = np.empty(M)
    kernels.squared_lengths(innovation, S, out)
    expected = np.einsum("ni,ni->n", innovation, np.linalg.solve(S, innovation[:, :, None])[:, :, 0])
    np.testing.assert_allclose(out[1:], expected[1:], rtol=1e-9)
    assert np.isnan(out[0])


def test_landmarks_around_the_rig(ekf: Ekf) -> None:
    P, R, arms = ekf.covariance.dense(), ekf.T[:3, :3], ekf.landmarks - ekf.T[:3, 3]
    points, spread = ekf.landmarks_in_rig()
    np.testing.assert_allclose(points, arms @ R, rtol=1e-12)
    for k, row in enumerate(ROWS):
        J = np.zeros((3, len(P)))
        J[:, :6] = np.hstack([-np.eye(3), skew(arms[k])])
        J[:, row : row + 3] = np.eye(3)
        np.testing.assert_allclose(spread[k], R.T @ J @ P @ J.T @ R, rtol=1e-9, atol=1e-9)


def test_new_points_with_the_pose_of_the_rig(rng: np.random.Generator) -> None:
    P, arms, own = covariances(rng, 1, CORE_DIM)[0], rng.standard_normal((3, 3)), covariances(rng, 3, 3)
    owned = Covariance(P)
    owned.append_points(arms, own)
    J = np.zeros((9, CORE_DIM))
    J[:, :6] = np.concatenate([np.broadcast_to(np.eye(3), (3, 3, 3)), -skew(arms)], axis=2).reshape(9, 6)
    F = np.vstack([np.eye(CORE_DIM), J])
    expected = F @ P @ F.T
    for k in range(3):
        block = slice(CORE_DIM + 3 * k, CORE_DIM + 3 * k + 3)
        expected[block, block] += own[k]
    np.testing.assert_allclose(owned.dense(), expected, rtol=1e-9, atol=1e-9)
    kept = np.array([0, 1, 5, 13, 20])
    np.testing.assert_array_equal(owned.dense(kept), owned.dense()[np.ix_(kept, kept)])


def test_a_right_invariant_error_moves_points(rng: np.random.Generator) -> None:
    points, shift, turn = rng.standard_normal((M, 3)), rng.standard_normal((M, 3)), rng.standard_normal(3)
    moved, change, V = np.empty((M, 3)), so3_exp(turn) - np.eye(3), so3_left_jacobian(turn)
    kernels.moved_points(points, shift, turn, change, V, moved)
    expected = points @ so3_exp(turn).T + (shift - np.cross(turn, points)) @ V.T
    np.testing.assert_allclose(points + moved, expected, rtol=1e-9, atol=1e-12)


def test_features_become_measurements_with_floors_on_their_noise(rng: np.random.Generator) -> None:
    uv, depth = rng.uniform(0.0, 400.0, (M, 2)).astype(np.float32), rng.uniform(1.0, 9.0, M).astype(np.float32)
    sigma_uv = rng.uniform(0.0, 0.1, (M, 2)).astype(np.float32)
    sigma_depth = rng.uniform(0.0, 0.02, M).astype(np.float32)
    index, z, variance = np.array([5, 0, 3]), np.empty((3, 3)), np.empty((3, 3))
    kernels.measured(uv, depth, sigma_uv, sigma_depth, index, 0.05, 0.01, z, variance)
    d = depth[index].astype(np.float64)
    sigma_w = np.maximum(sigma_depth[index].astype(np.float64), 0.01) / d**2
    np.testing.assert_array_equal(z, np.column_stack([uv[index], 1.0 / d]))
    expected = np.column_stack([np.maximum(sigma_uv[index].astype(np.float64), 0.05), sigma_w]) ** 2
    np.testing.assert_allclose(variance, expected, rtol=1e-15)
