# SPDX-License-Identifier: Apache-2.0
"""What the calibration leaves unknown: its effect on poses, and covariances that own up to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.results import EkfResult
from ekf_slam_node.slam import EkfSlam
from feature_world import T_RIG_OPTICAL, loop, room
from slam_core.estimation.calibration_error import CalibrationErrorConfig, pose_sensitivity
from slam_core.evaluation import anees_bounds, nees
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, make_transform, so3_exp
from slam_core.types import Submap

RUNS = 12
DOUBT = CalibrationErrorConfig(sigma_scale=0.02, sigma_mounting=0.01)


def distorted(T: FloatArray, error: FloatArray) -> FloatArray:
    """A pose as a rig sees it whose calibration is wrong by (scale, turn)."""
    E = make_transform(so3_exp(error[1:]), np.zeros(3))
    moved = E @ T @ invert_transform(E)
    return make_transform(moved[:3, :3], (1.0 + error[0]) * moved[:3, 3])


def test_sensitivity_is_the_derivative(rng: np.random.Generator) -> None:
    T = boxplus(np.eye(4), rng.standard_normal(6))
    step = 1e-6
    for k, unit in enumerate(np.eye(4)):
        change = boxminus(distorted(T, step * unit), distorted(T, -step * unit)) / (2.0 * step)
        np.testing.assert_allclose(pose_sensitivity(T)[:, k], change, atol=1e-8)


def badly_calibrated(seed: int, calibration: CalibrationErrorConfig) -> tuple[EkfResult, list[Submap], FloatArray]:
    """A run with a scale and a mounting that are wrong by DOUBT's standard deviations; the true last pose."""
    rng = np.random.default_rng(seed)
    world, poses = room(rng), loop(30, 10.0, 1.5, 0.3, handheld=0.02)
    stretch = 1.0 + DOUBT.sigma_scale * rng.standard_normal()
    turned = make_transform(so3_exp(DOUBT.sigma_mounting * rng.standard_normal(3)), np.zeros(3)) @ T_RIG_OPTICAL
    slam, submaps = EkfSlam(EkfSlamConfig(calibration=calibration), turned), []
    for k, T in enumerate(poses):
        seen, _ = world.features(T, k * 100_000_000, rng)
        wrong = replace(
            seen,
            xyz=seen.xyz * np.float32(stretch),
            depth=seen.depth * np.float32(stretch),
            sigma_depth=seen.sigma_depth * np.float32(stretch),
        )
        result = slam.process(wrong)
        submaps += result.submaps
    return result, submaps, invert_transform(poses[0]) @ poses[-1]


@pytest.mark.parametrize(("calibration", "honest"), [(DOUBT, True), (CalibrationErrorConfig(), False)])
def test_poses_of_a_badly_calibrated_rig(calibration: CalibrationErrorConfig, honest: bool) -> None:
    values = []
    for seed in range(RUNS):
        result, submaps, truth = badly_calibrated(seed, calibration)
        assert submaps
        assert all(np.linalg.eigvalsh(submap.covariance)[0] > 0.0 for submap in submaps)
        values.append(nees(boxminus(truth, result.pose.T), result.pose.covariance))
    low, high = anees_bounds(6, RUNS)
    assert (low < np.mean(values) / 6 < high) == honest


def test_submaps_do_not_take_a_common_error_for_their_own() -> None:
    exact, doubted = (badly_calibrated(0, c)[1][0] for c in (CalibrationErrorConfig(), DOUBT))
    np.testing.assert_array_equal(doubted.covariance, exact.covariance)
    np.testing.assert_array_equal(doubted.path[-1].covariance, exact.path[-1].covariance)
