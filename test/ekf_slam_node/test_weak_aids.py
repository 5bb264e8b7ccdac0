# SPDX-License-Identifier: Apache-2.0
"""Aids at low frame rates, where the motion model knows little: a weak one does no harm, a wrong one is outvoted."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.config import EkfSlamConfig
from ekf_slam_node.odometry.relative_poses import MEAN_TURN_RATE_SIGMA
from ekf_slam_node.results import EkfResult
from ekf_slam_node.slam import EkfSlam
from feature_world import loop, room
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, so3_log
from slam_core.types import ImuSample, RelativeMotion

STEP_NS = 800_000_000
SURE = np.diag(np.repeat([0.009, 0.004], 3) ** 2)


def uneven(steps: int, rng: np.random.Generator) -> list[FloatArray]:
    """A walk round a room in steps that no constant velocity foretells."""
    sway = np.repeat([0.08, 0.03], 3)
    return [boxplus(T, sway * rng.standard_normal(6)) for T in loop(steps)]


def nees(poses: list[FloatArray], result: EkfResult) -> float:
    error = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
    return float(error @ np.linalg.solve(result.pose.covariance, error)) / 6


@pytest.mark.parametrize("imu", [False, True])
def test_a_weak_aid_does_not_move_the_point_of_linearisation(imu: bool) -> None:
    values = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        world, poses, slam = room(rng, 700), uneven(12, rng), EkfSlam(EkfSlamConfig())
        for k, T in enumerate(poses):
            if k and imu:
                rate = so3_log(poses[k - 1][:3, :3].T @ T[:3, :3]) / (STEP_NS * 1e-9)
                rate = rate + 0.3 * MEAN_TURN_RATE_SIGMA * rng.standard_normal(3)
                for part in range(10):
                    slam.process_imu(ImuSample((k - 1) * STEP_NS + part * STEP_NS // 10 + 1, rate, np.zeros(3)))
            result = slam.process(world.features(T, k * STEP_NS, rng, max_features=150)[0])
        values.append(nees(poses, result))
    assert np.mean(values) < 2.0


def test_odometry_that_has_slid_along_a_wall_is_outvoted(rng: np.random.Generator) -> None:
    """Wrong by 15 cm and sure of 9 mm, where the motion model would believe either."""
    world, poses, slam = room(rng), uneven(12, rng), EkfSlam(EkfSlamConfig())
    for k, T in enumerate(poses):
        if k:
            slid = np.array([0.0, 0.15, 0.0, 0.0, 0.0, 0.0]) if k == 6 else np.zeros(6)
            step = boxplus(invert_transform(poses[k - 1]) @ T, slid)
            slam.process_motion(RelativeMotion((k - 1) * STEP_NS, k * STEP_NS, step, SURE))
        result = slam.process(world.features(T, k * STEP_NS, rng)[0])
    assert slam.counters.counts["aids_rejected"] == 1
    error = boxminus(invert_transform(poses[0]) @ poses[-1], result.pose.T)
    assert np.linalg.norm(error[:3]) < 0.06
