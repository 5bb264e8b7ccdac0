# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from judging import errors, join
from submap_world import Agent, circle, ring_world

from sjsam_node.global_map import GlobalMap, GlobalMapConfig
from sjsam_node.smoothing.inner_poses import smoothing_gains
from sjsam_node.smoothing.map_snapshot import STILL, _moving
from slam_core.estimation.calibration_error import CalibrationErrorConfig
from slam_core.geometry import FloatArray, make_transform
from slam_core.types import PoseEstimate, Submap


def mean_nees(claim: float) -> float:
    """Mean NEES per degree of freedom of joined poses whose submaps claim ``claim`` times their true covariance."""
    values = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 1.25), rng, "a")
        submaps = [
            replace(
                s,
                covariance=claim * s.covariance,
                path=tuple(replace(p, covariance=claim * p.covariance) for p in s.path),
            )
            for s in agent.submaps()
        ]
        joined, _ = join(submaps)
        joined.settle()
        values.append(errors(joined, agent)[1].mean() / 6.0)
    return float(np.mean(values))


def test_submaps_that_are_too_sure_of_themselves_give_a_map_that_is_not() -> None:
    assert mean_nees(0.25) == pytest.approx(mean_nees(1.0), rel=0.35)


def walk(steps: int, frame_noise: FloatArray, step_noise: FloatArray) -> Submap:
    """A submap on the spot: each pose errs by its own frame's noise, the first frame's, and a random walk."""
    covariances = [np.zeros((6, 6))] + [2.0 * frame_noise + k * step_noise for k in range(1, steps + 1)]
    path = tuple(PoseEstimate(k, np.eye(4), P) for k, P in enumerate(covariances))
    return Submap(
        "a", 0, 0, steps, np.eye(4), np.empty((0, 3)), covariances[-1], np.empty(0, np.int64), np.empty(0, np.int32),
        np.empty((0, 8), np.float32), path,
    )  # fmt: skip


def test_a_pose_is_corrected_by_the_end_only_as_far_as_the_two_share_errors(rng: np.random.Generator) -> None:
    A = rng.normal(size=(6, 6))
    frame_noise, step_noise = A @ A.T + np.eye(6), np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    submap = walk(5, frame_noise, step_noise)
    for k in (1, 3):
        (gain,), (remaining,) = smoothing_gains(submap, [submap.path[k]])
        shared = frame_noise + (k - 0.5) * step_noise  # half of the first step counts as noise of its frame
        expected = shared @ np.linalg.inv(submap.covariance[:6, :6])
        assert np.allclose(gain, expected)
        assert np.allclose(remaining, submap.path[k].covariance - expected @ shared.T)


def test_a_pose_less_sure_than_the_end_is_moved_no_farther_than_the_end(rng: np.random.Generator) -> None:
    """A rig that came back to landmarks of the start is surer of the end than it was on the way."""
    A = rng.normal(size=(6, 6))
    submap = replace(walk(6, 1e-6 * np.eye(6), A @ A.T + np.eye(6)), covariance=0.01 * (A @ A.T + np.eye(6)))
    for k in (2, 4):
        (gain,), (remaining,) = smoothing_gains(submap, [submap.path[k]])
        assert np.allclose(gain, np.eye(6))
        assert np.allclose(remaining, submap.path[k].covariance - submap.covariance)


def test_the_ends_of_a_submap_are_the_skeleton_itself() -> None:
    submap = walk(4, np.eye(6), 0.1 * np.eye(6))
    for pose, gain in ((submap.path[0], np.zeros((6, 6))), (submap.path[-1], np.eye(6))):
        (found,), (remaining,) = smoothing_gains(submap, [pose])
        assert np.array_equal(found, gain)
        assert not remaining.any()


def test_a_correction_turns_about_the_lever_arm_of_what_is_left_of_the_way() -> None:
    submap = walk(4, 1e-9 * np.eye(6), np.eye(6))
    moved = make_transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
    submap = replace(submap, end_pose=moved, path=(*submap.path[:-1], replace(submap.path[-1], T=moved)))
    (gain,), _ = smoothing_gains(submap, [submap.path[2]])
    lever = np.eye(6)
    lever[1, 5], lever[2, 4] = 1.0, -1.0  # turns about z and y move a point 1 m ahead
    assert gain @ submap.covariance[:6, :6] == pytest.approx(1.5 * lever.T)


def test_a_wrong_scale_widens_what_goes_out_and_leaves_the_map(rng: np.random.Generator) -> None:
    agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.6), rng, "a")
    submaps, doubt = agent.submaps(), CalibrationErrorConfig(sigma_scale=0.05, sigma_mounting=0.01)
    exact, doubted = GlobalMap(), GlobalMap(GlobalMapConfig(calibration=doubt))
    for joined in (exact, doubted):
        for submap in submaps:
            joined.add(submap)
    far = 0
    for before, after in zip(exact.trajectory("a"), doubted.trajectory("a"), strict=True):
        np.testing.assert_array_equal(after.T, before.T)
        added, position = after.covariance - before.covariance, before.T[:3, 3]
        assert position @ added[:3, :3] @ position == pytest.approx((0.05 * position @ position) ** 2, abs=1e-9)
        far += np.linalg.norm(position) > 2.0
    assert far
    before, after = exact.landmarks(), doubted.landmarks()
    np.testing.assert_array_equal(after.positions, before.positions)
    along = np.einsum("ni,nij,nj->n", before.positions, after.covariances - before.covariances, before.positions)
    np.testing.assert_allclose(along, (0.05 * np.square(before.positions).sum(axis=1)) ** 2, atol=1e-6)
    assert doubted.end_pose("a").covariance[0, 0] > exact.end_pose("a").covariance[0, 0]


def test_a_path_shows_every_movement_and_little_of_standing_still(rng: np.random.Generator) -> None:
    def pose(k: int, x: float) -> PoseEstimate:
        T = np.eye(4)
        T[:3, 3] = [x, *rng.normal(scale=2e-4, size=2)]
        return PoseEstimate(k, T, np.eye(6))

    standing = [pose(k, 0.0) for k in range(300)]
    creeping = [pose(300 + k, 0.001 * k) for k in range(1, 101)]
    kept = _moving([*standing, *creeping])
    assert len(kept) < 60
    assert kept[0] is standing[0]
    assert kept[-1] is creeping[-1]
    stamps, x = [p.stamp_ns for p in kept], [p.T[0, 3] for p in kept]
    for p in (*standing, *creeping):
        before = [i for i, stamp in enumerate(stamps) if stamp <= p.stamp_ns][-1]
        assert abs(x[before] - p.T[0, 3]) < STILL[0] + 1e-9
