# SPDX-License-Identifier: Apache-2.0
"""ATE and RPE against evo's published figures, NEES against its chi-square law, alignment by properties."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.evaluation import TruthAccuracy, align, anees_bounds, associate, evaluate, pose_nees
from slam_core.geometry import boxplus, invert_transform, make_transform, so3_exp
from slam_core.trajectory import Trajectory, read_trajectory


def random_walk(rng: np.random.Generator, n: int = 60) -> Trajectory:
    steps = np.column_stack([rng.normal([0.2, 0.0, 0.0], 0.05, (n, 3)), rng.normal(0, 0.05, (n, 3))])
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ boxplus(np.eye(4), step))
    return Trajectory(np.arange(n, dtype=np.int64) * 100_000_000, np.stack(poses))


@pytest.mark.data
@pytest.mark.parametrize(
    ("estimate", "truth", "rmse"),
    [
        ("KITTI_00_ORB.txt", "KITTI_00_gt.txt", 1.303),
        ("KITTI_00_SPTAM.txt", "KITTI_00_gt.txt", 3.738),
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", 0.00812),
        ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", 0.01347),
    ],
)
def test_ate_agrees_with_evo(data_dir, estimate, truth, rmse):
    folder = data_dir / "traj_evo"
    result = evaluate(read_trajectory(folder / estimate), read_trajectory(folder / truth))
    assert result.ate.rmse == pytest.approx(rmse, rel=1e-3)


def test_rigid_motion_of_the_estimate_changes_nothing(rng):
    truth = random_walk(rng)
    moved = make_transform(so3_exp(np.array([0.3, -1.0, 2.0])), np.array([5.0, -3.0, 1.0])) @ truth.poses
    for alignment in ("se3", "origin"):
        np.testing.assert_allclose(align(moved, truth.poses, alignment), truth.poses, atol=1e-9)
    result = evaluate(Trajectory(truth.stamps_ns, moved), truth)
    assert result.ate.max < 1e-9
    assert result.rpe.max < 1e-9
    assert result.end_error_m < 1e-9


def test_rpe_of_a_constant_scale_error(rng):
    truth = random_walk(rng)
    poses = truth.poses.copy()
    poses[:, :3, 3] *= 1.1
    step = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    result = evaluate(Trajectory(truth.stamps_ns, poses), truth)
    assert result.rpe.mean == pytest.approx(0.1 * step.mean(), rel=1e-9)
    assert result.rpe_rotation_deg.max < 1e-5


def test_anees_of_honest_covariances_is_one_and_of_optimistic_ones_is_not(rng):
    truth = random_walk(rng, 400)
    A = rng.normal(size=(6, 6))
    P = 1e-4 * (A @ A.T + np.eye(6))
    errors = rng.multivariate_normal(np.zeros(6), P, size=len(truth))
    errors[0] = 0.0
    estimate = Trajectory(truth.stamps_ns, boxplus(truth.poses, -errors), np.tile(P, (len(truth), 1, 1)))
    low, high = anees_bounds(6, len(truth) - 1)
    assert low < pose_nees(estimate, truth.poses).mean() / 6 < high
    boastful = Trajectory(estimate.stamps_ns, estimate.poses, estimate.covariances / 2)
    assert pose_nees(boastful, truth.poses).mean() / 6 > high


def test_anees_is_independent_of_the_frame_of_ground_truth(rng):
    truth = random_walk(rng)
    world = make_transform(so3_exp(np.array([0.1, 0.2, -2.0])), np.array([4.0, 5.0, 6.0]))
    noisy = boxplus(truth.poses, rng.normal(0, 0.01, (len(truth), 6)))
    noisy = invert_transform(noisy[0]) @ noisy
    estimate = Trajectory(truth.stamps_ns, noisy, np.tile(1e-4 * np.eye(6), (len(truth), 1, 1)))
    np.testing.assert_allclose(pose_nees(estimate, truth.poses), pose_nees(estimate, world @ truth.poses), rtol=1e-6)


def test_anees_knows_the_error_of_ground_truth(rng):
    """Truth off by a known error at every pose, the first too, far from the start and in a turned map."""
    straight = [make_transform(np.eye(3), np.array([2.0 * k, 0.0, 0.0])) for k in range(5)]
    start = make_transform(so3_exp(np.array([0.4, -0.8, 1.9])), np.array([1.0, 2.0, 3.0]))
    poses, stamps = start @ np.stack(straight), np.arange(5, dtype=np.int64)
    covariance = np.tile(np.diag([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4]) ** 2, (5, 1, 1))
    accuracy = TruthAccuracy(position=0.02, rotation=0.01)
    values = []
    for _ in range(400):
        error = rng.normal(size=(5, 6)) * np.repeat([accuracy.position, accuracy.rotation], 3)
        estimate = boxplus(poses, rng.normal(size=(5, 6)) * np.sqrt(covariance[0].diagonal()))
        estimate[0] = poses[0]
        values.append(pose_nees(Trajectory(stamps, estimate, covariance), boxplus(poses, error), accuracy))
    by_distance = np.mean(values, axis=0) / 6.0
    low, high = anees_bounds(6, 400, 0.999)
    assert (by_distance > low).all()
    assert (by_distance < high).all()
    with pytest.raises(ValueError, match="not negative"):
        TruthAccuracy(position=-0.1)


def test_association_by_nearest_and_by_interpolation(rng):
    truth = random_walk(rng)
    later = Trajectory(truth.stamps_ns[:-1] + 50_000_000, truth.poses[:-1])
    with pytest.raises(ValueError, match="fewer than two poses"):
        associate(later, truth)
    _, poses = associate(later, truth, max_difference_s=0.2, interpolate=True)
    middle = (truth.poses[:-1, :3, 3] + truth.poses[1:, :3, 3]) / 2
    np.testing.assert_allclose(poses[:, :3, 3], middle, atol=1e-12)


def test_bad_arguments_are_named(rng):
    truth = random_walk(rng)
    with pytest.raises(ValueError, match="alignment must be one of"):
        evaluate(truth, truth, alignment="sim3")
    with pytest.raises(ValueError, match="covariances"):
        pose_nees(truth, truth.poses)
