# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools

import numpy as np
import pytest

from sjsam_node.correction import CorrectionLimit, MapToOdom
from sjsam_node.node_config import SjsamNodeConfig
from sjsam_node.pose_tracker import PoseTracker
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    invert_transform,
    is_rigid_transform,
    make_transform,
    rotation_from_euler,
    so3_log,
    transform_points,
)
from slam_core.types import PoseEstimate

SPEED, RATE = 0.1, 0.05
START = make_transform(rotation_from_euler(0.4, 0.1), np.array([2.0, -1.0, 0.3]))
RIG = np.array([7.0, 3.0, 0.5])
STEP_NS = 50_000_000


def pose_at(stamp_ns: int, T: FloatArray, sigma: float = 0.01) -> PoseEstimate:
    return PoseEstimate(stamp_ns, T, sigma**2 * np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]))


def angle(T: FloatArray) -> float:
    return float(np.linalg.norm(so3_log(T[:3, :3])))


def way(limit: CorrectionLimit, wanted: FloatArray, steps: int, start_ns: int = 0) -> list[FloatArray]:
    passed: list[FloatArray] = []
    while len(passed) < steps and not (passed and np.array_equal(passed[-1], wanted)):
        passed.append(limit.follow(start_ns + (len(passed) + 1) * STEP_NS, wanted, RIG))
    return passed


@pytest.mark.parametrize(
    "change",
    [
        np.array([1.0, 2.0, -0.5, 0.0, 0.0, 0.0]),
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.8]),
        np.array([-1.0, 0.5, 0.2, 0.3, -0.2, 0.9]),
        np.array([0.3, 0.0, 0.0, 0.0, 0.0, np.pi]),
    ],
)
def test_neither_origin_nor_rig_nor_angle_goes_faster_and_one_of_them_goes_as_fast(change):
    limit, wanted, step_s = CorrectionLimit(SPEED, RATE), boxplus(START, change), 1e-9 * STEP_NS
    passed = [limit.follow(0, START, RIG), *way(limit, wanted, 8000)]
    assert all(is_rigid_transform(T) for T in passed)
    moved = [T for T in passed if not np.array_equal(T, wanted)]
    assert len(moved) > 100
    assert np.array_equal(passed[-1], wanted), "arrived, to the bit"
    for before, after in itertools.pairwise(moved):
        shares = [
            np.linalg.norm(transform_points(after, p[None]) - transform_points(before, p[None])) / (SPEED * step_s)
            for p in (np.zeros(3), RIG)
        ] + [angle(invert_transform(before) @ after) / (RATE * step_s)]
        # The chord is shorter than the arc by (turn per step)^2 / 24.
        assert max(shares) == pytest.approx(1.0, abs=1e-6)
        assert max(shares) <= 1.0 + 1e-9


def test_the_way_is_the_geodesic():
    """The screw that leads to the end is the same from everywhere on the way."""
    limit, wanted = CorrectionLimit(SPEED, RATE), boxplus(START, np.array([-1.0, 0.5, 0.2, 0.3, -0.2, 0.9]))
    limit.follow(0, START, RIG)
    axes = [so3_log((invert_transform(T) @ wanted)[:3, :3]) for T in (START, *way(limit, wanted, 100))]
    for axis in axes:
        assert axis / np.linalg.norm(axis) == pytest.approx(axes[0] / np.linalg.norm(axes[0]), abs=1e-9)


def test_without_bounds_the_estimate_is_published_at_once():
    limit = CorrectionLimit(0.0, 0.0)
    for stamp_ns, T in enumerate((START, np.eye(4), START)):
        assert limit.follow(stamp_ns, T, RIG) is T
    only_rate = CorrectionLimit(0.0, RATE)
    only_rate.follow(0, np.eye(4), RIG)
    assert only_rate.follow(1, make_transform(np.eye(3), np.ones(3)), RIG)[0, 3] == 1.0, "a translation has no angle"


def test_stamps_that_go_back_move_nothing_and_are_not_gone_twice():
    limit, wanted = CorrectionLimit(SPEED, 0.0), make_transform(np.eye(3), np.array([5.0, 0.0, 0.0]))
    limit.follow(0, np.eye(4), RIG)
    xs = [limit.follow(round(1e9 * s), wanted, RIG)[0, 3] for s in (1.0, 0.5, 1.0, 2.0)]
    assert xs == pytest.approx([0.1, 0.1, 0.1, 0.2])
    xs = [limit.follow(round(1e9 * s), wanted, RIG)[0, 3] for s in (-100.0, -99.0)]
    assert xs == pytest.approx([0.2, 0.3]), "a clock that was set back"


def placed(jump_m: float, speed: float = SPEED) -> tuple[MapToOdom, list[float]]:
    """A rig whose place in the map has just jumped, and its clock."""
    now = [0.0]
    found = MapToOdom(SjsamNodeConfig(max_correction_speed=speed), lambda: now[0])
    tracker = PoseTracker(np.eye(4))
    found.start(tracker)
    in_odom = pose_at(10**9, make_transform(rotation_from_euler(1.0), RIG))
    tracker.add_odometry(in_odom)
    found.heard()
    assert found.at_present(0, 0.2) is not None
    tracker.add_submap(pose_at(10**9, boxplus(in_odom.T, np.array([jump_m, 0, 0, 0, 0, 0]))))
    return found, now


def test_the_covariance_covers_what_is_held_back_and_grows_with_it():
    variances, held_back = [], []
    for jump_m in (0.0, 0.5, 1.0, 2.0):
        found, now = placed(jump_m)
        now[0] = 0.5
        pose, behind_m = found.at_present(0, 0.2)
        np.linalg.cholesky(pose.covariance)
        error = boxminus(found.tracker.map_to_odom().T, pose.T)
        assert error @ np.linalg.solve(pose.covariance, error) < 1.0
        variances.append(pose.covariance[0, 0])
        held_back.append(behind_m)
    assert held_back == pytest.approx([0.0, 0.45, 0.95, 1.95])
    assert np.diff(variances) == pytest.approx(np.diff(np.square(held_back)))
    unbounded, _ = placed(2.0, speed=0.0)
    pose, behind_m = unbounded.at_present(0, 0.2)
    assert behind_m == 0.0
    assert pose.covariance[0, 0] == pytest.approx(variances[0])


def test_with_the_odometry_as_exact_the_rig_is_as_uncertain_as_it_is_in_the_map(rng):
    found, _ = placed(1.0, speed=0.0)
    pose, _ = found.at_present(0, 0.2)
    in_odom = found.tracker.newest_in_odom()
    drawn = rng.multivariate_normal(np.zeros(6), 1e-4 * pose.covariance, 20_000, method="cholesky")
    errors = boxminus(boxplus(pose.T, drawn) @ in_odom.T, pose.T @ in_odom.T)
    expected = 1e-4 * found.tracker.pose_of(in_odom).covariance
    assert np.cov(errors.T) == pytest.approx(expected, abs=0.05 * expected.max())


def test_who_is_lost_is_silent_and_begins_where_he_is_found():
    found, now = placed(3.0)
    found.lose()
    now[0] = 0.1
    assert found.at_present(0, 0.2) is None
    found.tracker.add_submap(pose_at(10**9, START))
    pose, behind_m = found.at_present(0, 0.2)
    assert behind_m == 0.0
    assert np.array_equal(pose.T, found.tracker.T_map_odom)


def test_a_late_odometry_takes_no_stamp_back():
    """By stamps, as tf2 keeps them, nothing moves faster for it."""
    found, now = placed(3.0)
    now[0] = 0.5
    first, _ = found.at_present(0, 0.2)
    found.tracker.add_odometry(pose_at(10**9 + 10**8, found.tracker.newest_in_odom().T))
    found.heard()
    second, _ = found.at_present(0, 0.2)
    assert second.stamp_ns == first.stamp_ns
    assert np.array_equal(second.T, first.T)


def test_nothing_is_said_before_the_odometry_is_heard():
    found = MapToOdom(SjsamNodeConfig())
    found.start(PoseTracker(np.eye(4)))
    assert found.at_present(0, 0.2) is None
