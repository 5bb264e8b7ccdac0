# SPDX-License-Identifier: Apache-2.0
"""The pose in the map between submaps: exact composition, honest covariance, and odometry that begins anew."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sjsam_node.pose_tracker import PoseTracker
from slam_core.geometry import FloatArray, boxminus, boxplus, compose_covariance, invert_transform
from slam_core.types import PoseEstimate

STEP_NS = 100_000_000


def chain(rng: np.random.Generator, n: int) -> list[PoseEstimate]:
    """Odometry whose covariance adds up from step to step."""
    T, P, out = np.eye(4), 1e-12 * np.eye(6), []
    for k in range(n):
        out.append(PoseEstimate(k * STEP_NS, T, P))
        step, Q = boxplus(np.eye(4), 0.1 * rng.normal(size=6)), np.diag(rng.uniform(1e-6, 1e-4, 6))
        T, P = T @ step, compose_covariance(T, P, step, Q)
    return out


def in_map(pose: PoseEstimate, T: FloatArray, sigma: float) -> PoseEstimate:
    return PoseEstimate(pose.stamp_ns, T @ pose.T, sigma**2 * np.eye(6))


def test_a_submaps_end_is_carried_on_by_the_odometry(rng: np.random.Generator) -> None:
    odometry, T_map_odom = chain(rng, 12), boxplus(np.eye(4), rng.normal(size=6))
    tracker = PoseTracker(np.eye(4))
    for pose in odometry[:6]:
        assert np.allclose(tracker.add_odometry(pose)[0].T, pose.T)
    tracker.add_submap(in_map(odometry[4], T_map_odom, 0.01))
    poses = [tracker.add_odometry(pose)[0] for pose in odometry[6:]]
    for pose, odom in zip(poses, odometry[6:], strict=True):
        assert np.abs(boxminus(pose.T, T_map_odom @ odom.T)).max() < 1e-9
    since = odometry[4:]
    T, P = since[0].T, np.zeros((6, 6))
    for a, b in pairwise(since):
        step = invert_transform(a.T) @ b.T
        Q = b.covariance - compose_covariance(a.T, a.covariance, step, np.zeros((6, 6)))
        P = compose_covariance(T_map_odom @ T, P, step, np.zeros((6, 6))) + _turned(T_map_odom, Q)
        T = b.T
    end = in_map(odometry[4], T_map_odom, 0.01)
    expected = compose_covariance(end.T, end.covariance, invert_transform(odometry[4].T) @ T, np.zeros((6, 6))) + P
    assert np.allclose(poses[-1].covariance, expected, atol=1e-11)


def _turned(T: FloatArray, Q: FloatArray) -> FloatArray:
    R = np.kron(np.eye(2), T[:3, :3])
    return np.asarray(R @ Q @ R.T)


def test_every_covariance_is_positive_definite_from_the_first_pose_on(rng: np.random.Generator) -> None:
    tracker = PoseTracker(np.eye(4))
    for k, pose in enumerate(chain(rng, 20)):
        if k in (5, 11):
            tracker.add_submap(in_map(pose, np.eye(4), 0.02), pose)
        for out in tracker.add_odometry(pose):
            assert np.linalg.eigvalsh(out.covariance).min() > 0.0


def test_a_restarted_odometry_goes_on_where_the_agent_was(rng: np.random.Generator) -> None:
    odometry = chain(rng, 10)
    tracker = PoseTracker(np.eye(4))
    for pose in odometry:
        last = tracker.add_odometry(pose)[0]
        if pose.stamp_ns == 4 * STEP_NS:
            tracker.add_submap(in_map(pose, np.eye(4), 0.01))
    again = [PoseEstimate(p.stamp_ns + 10 * STEP_NS, p.T, p.covariance) for p in odometry]
    first = tracker.add_odometry(again[0])[0]
    assert np.abs(boxminus(first.T, last.T)).max() < 1e-9


def test_nothing_is_said_of_an_agent_whose_place_is_unknown_and_odd_stamps_are_not_followed(
    rng: np.random.Generator,
) -> None:
    odometry = chain(rng, 6)
    lost = PoseTracker(None)
    assert lost.add_odometry(odometry[0]) == []
    lost.add_submap(in_map(odometry[0], np.eye(4), 0.01))
    assert len(lost.add_odometry(odometry[1])) == 1
    odd = PoseEstimate(10**15, np.eye(4), odometry[0].covariance)
    assert lost.add_odometry(odd) == []
    assert lost.newest_ns == STEP_NS
