# SPDX-License-Identifier: Apache-2.0
"""What a joint calibration claims of lengths and directions, against points triangulated with it."""

from __future__ import annotations

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from slam_calibration.board import Chessboard
from slam_calibration.bundle import LensState, Rig, adjust
from slam_calibration.length_error import DISTANCE, PairError, pair_error, parameter_file
from slam_core.estimation.calibration_error import CalibrationErrorConfig
from slam_core.geometry import FloatArray, transform_points
from slam_simulation.calibration.board_views import beside, covering_view, example_camera, simulate_views

BOARD = Chessboard(9, 7, 0.04).points
PAIR = (example_camera("plumb_bob"), example_camera("plumb_bob", beside(0.12, 0.0, (0.01, -0.02, 0.0))))
GRID = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 5)), axis=-1).reshape(-1, 2)


def triangulated(states: tuple[LensState, ...], pixels: list[FloatArray]) -> FloatArray:
    """Points (n, 3) in the left optical frame, nearest to both rays."""
    rays = [
        np.column_stack([s.camera.normalised_from_pixels(p), np.ones(len(p))])
        for s, p in zip(states, pixels, strict=True)
    ]
    R, t = states[1].T[:3, :3], states[1].T[:3, 3]
    right = rays[1] @ R  # in the left frame
    A = np.stack([rays[0], -right], axis=2)
    along = np.array([np.linalg.lstsq(a, -R.T @ t, rcond=None)[0] for a in A])
    return 0.5 * (rays[0] * along[:, :1] + right * along[:, 1:] - R.T @ t)


def test_lengths_directions_and_disparities_err_as_the_calibration_claims() -> None:
    true_points = DISTANCE * np.column_stack([GRID, np.ones(len(GRID))])
    pixels = [s.camera.project(transform_points(s.T, true_points)) for s in PAIR]
    np.testing.assert_allclose(triangulated(PAIR, pixels), true_points, atol=1e-6)
    ratios, sigmas = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        poses = tuple(covering_view(rng, PAIR[0]) for _ in range(12))
        views = simulate_views(rng, BOARD, PAIR, poses, 0.15)
        found = adjust(BOARD - BOARD.mean(axis=0), views, Rig(PAIR, poses))
        claimed = pair_error(found.rig.cameras, found.covariance)
        points = triangulated(found.rig.cameras, pixels)
        scale = np.sum(points * true_points) / np.sum(true_points**2) - 1.0
        angle = Rotation.align_vectors(points, true_points)[0].as_rotvec()
        disparity = PAIR[0].parameters[0] * np.linalg.norm(PAIR[1].T[:3, 3]) * (1.0 / points[:, 2] - 1.0 / DISTANCE)
        ratios.append(
            [
                scale**2 / claimed.lengths.sigma_scale**2,
                np.mean(angle**2) / claimed.lengths.sigma_mounting**2,
                np.mean(disparity**2) / claimed.sigma_disparity**2,
            ]
        )
        sigmas.append(claimed.lengths.sigma_scale)
    assert 5e-4 < np.mean(sigmas) < 4e-3
    for nees in np.mean(ratios, axis=0):
        assert 0.4 < nees < 2.0


def test_the_file_sets_the_parameters_of_every_node_that_has_them() -> None:
    values = yaml.safe_load(parameter_file(PairError(CalibrationErrorConfig(0.002, 0.0003), 0.04)))["/**"][
        "ros__parameters"
    ]
    assert values == {
        "calibration.sigma_scale": 0.002,
        "calibration.sigma_mounting": 0.0003,
        "self_calibration.sigma_disparity": 0.04,
    }
