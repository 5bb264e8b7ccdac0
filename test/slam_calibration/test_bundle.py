# SPDX-License-Identifier: Apache-2.0
"""The bundle's parts: derivatives of the residuals, robustness, and the covariance against a dense solution."""

from __future__ import annotations

import numpy as np

from slam_calibration.board import Chessboard
from slam_calibration.bundle import (
    BundleConfig,
    BundleResult,
    Rig,
    _moved,
    _residual_with_jacobians,
    _residuals,
    adjust,
)
from slam_calibration.detection import Corners
from slam_core.geometry import FloatArray
from slam_simulation.calibration.board_views import beside, example_camera, random_view, simulate_views

BOARD = Chessboard(7, 5, 0.05)
POINTS = BOARD.points - BOARD.points.mean(axis=0)


def make(rng: np.random.Generator, noise_px: float = 0.1, count: int = 8) -> tuple[list[list[Corners]], Rig]:
    cameras = (example_camera("plumb_bob"), example_camera("equidistant", beside(0.1, 0.02, (0.01, 0.02, -0.03))))
    poses = tuple(random_view(rng) for _ in range(count))
    return simulate_views(rng, BOARD.points, cameras, poses, noise_px), Rig(cameras, poses)


def dense_jacobian(views: list[list[Corners]], rig: Rig) -> FloatArray:
    """Central differences of all predicted pixels by the rig's parameters and every board pose."""
    n, v, step = len(rig.names), len(views), 1e-6

    def predicted(d: FloatArray) -> FloatArray:
        moved = _moved(rig, d[:n], d[n:].reshape(v, 6))
        parts = [_residuals(POINTS, k, moved, i, c) for i, view in enumerate(views) for c, k in enumerate(view)]
        return -np.concatenate(parts).ravel()

    return np.column_stack([(predicted(d) - predicted(-d)) / (2 * step) for d in step * np.eye(n + 6 * v)])


def test_jacobians_against_central_differences(rng: np.random.Generator) -> None:
    views, rig = make(rng, count=2)
    numeric, n, row = dense_jacobian(views, rig), len(rig.names), 0
    for i, view in enumerate(views):
        for c, corners in enumerate(view):
            _, J_rig, J_pose = _residual_with_jacobians(POINTS, corners, rig, i, c)
            rows = slice(row, row + 2 * len(corners))
            np.testing.assert_allclose(J_rig.reshape(-1, n), numeric[rows, :n], atol=2e-3)
            np.testing.assert_allclose(J_pose.reshape(-1, 6), numeric[rows, n + 6 * i : n + 6 * i + 6], atol=2e-3)
            row += 2 * len(corners)


def test_covariance_is_that_of_the_dense_problem(rng: np.random.Generator) -> None:
    views, rig = make(rng)
    config = BundleConfig(huber_px=100.0, distortion_prior=1e4)
    result = adjust(POINTS, views, rig, config)
    J, n = dense_jacobian(views, result.rig), len(rig.names)
    residual = np.concatenate([r for view in result.residuals for r in view]).ravel()
    variance = residual @ residual / (len(residual) - J.shape[1])
    scale = 1.0 / np.linalg.norm(J, axis=0)
    dense = np.linalg.inv((J * scale).T @ (J * scale)) * np.outer(scale, scale) * variance
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance)), np.sqrt(np.diag(dense)[:n]), rtol=1e-2)
    assert np.abs(J.T @ residual * scale).max() < 1e-3 * np.linalg.norm(residual)


def disturbed(rng: np.random.Generator, huber_px: float) -> tuple[BundleResult, Rig]:
    views, rig = make(rng)
    for view in views:
        view[0].pixels[::8] += 12.0
    return adjust(POINTS, views, rig, BundleConfig(huber_px=huber_px)), rig


def test_huber_loss_limits_wrong_corners(rng: np.random.Generator) -> None:
    errors = []
    for huber_px in (0.5, 100.0):
        result, truth = disturbed(np.random.default_rng(4), huber_px)
        errors.append(np.abs(result.rig.cameras[0].parameters[:4] - truth.cameras[0].parameters[:4]).max())
    assert errors[0] < 0.3 * errors[1]


def test_a_view_that_nobody_saw_keeps_its_pose(rng: np.random.Generator) -> None:
    views, rig = make(rng)
    nothing = Corners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    views[3] = [nothing, nothing]
    result = adjust(POINTS, views, rig)
    assert result.converged
    np.testing.assert_allclose(result.rig.board_poses[3], rig.board_poses[3], atol=1e-12)
