# SPDX-License-Identifier: Apache-2.0
"""Unstable landmarks are removed (section 4.4), and Eq. 7.1's start is what conditioning says."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.association.association import (
    associate_ccda,
    associate_jcbb,
    associate_mahalanobis,
    associate_nearest,
)
from ekf_slam_node.config import EkfSlamConfig, FeatureAssociationConfig, LandmarkConfig, SubmapConfig
from ekf_slam_node.filtering.candidates import Candidates
from ekf_slam_node.filtering.ekf import Ekf
from ekf_slam_node.filtering.landmarks import LandmarkTable, spread_choice
from ekf_slam_node.filtering.models import CORE_DIM, frame_from_features, rig_points
from ekf_slam_node.slam import EkfSlam
from feature_world import T_RIG_OPTICAL, loop, room
from slam_core.geometry import make_transform, rotation_from_euler


def book_of(sightings: list[int]) -> LandmarkTable:
    table = LandmarkTable(4)
    n = len(sightings)
    table.add(
        np.arange(n), np.array(sightings), np.eye(4, dtype=np.float32)[np.arange(n) % 4], 1 + np.arange(n), frame=10
    )
    return table


def test_points_are_chosen_from_the_emptiest_cells_in_the_order_given(rng):
    size, cells = (640, 480), np.array([8, 6])
    points, occupied = rng.uniform([-5.0, -5.0], [650.0, 485.0], (2, 150, 2))
    column_row = [np.clip((px * cells / size).astype(int), 0, cells - 1) for px in (points, occupied)]
    load, own = np.zeros(cells), column_row[0]
    np.add.at(load, tuple(column_row[1].T), 1)
    place = [load[tuple(cell)] + (own[:n] == cell).all(axis=1).sum() for n, cell in enumerate(own)]
    expected = np.argsort(place, kind="stable")[:60]
    np.testing.assert_array_equal(spread_choice(points, occupied, 60, size), expected)
    assert len(spread_choice(points[:0], occupied, 60, size)) == 0


def test_landmarks_with_too_few_sightings_leave_after_their_probation():
    config = LandmarkConfig(min_sightings=3, probation_frames=6)
    table = book_of([1, 2, 3, 7])
    assert table.unreliable(15, config).tolist() == []
    assert table.unreliable(16, config).tolist() == [1, 0]


def test_landmarks_that_are_missed_where_they_should_be_seen_leave():
    config = LandmarkConfig(min_hit_ratio=0.25, min_expected=12)
    table = book_of([9, 9])
    for k in range(12):
        seen = np.array([0]) if k % 3 == 0 else np.array([], dtype=np.int64)
        table.count(seen, np.zeros((len(seen), 4), np.float32), expected=np.array([True, True]))
    assert table.unreliable(11, config).tolist() == [1]


def test_points_that_exist_only_for_a_moment_do_not_stay_in_the_map(rng):
    """Half of the features are phantoms that live for two frames: the map must consist of the others."""
    world, phantoms = room(rng, 500), room(rng, 4000)
    one_submap = SubmapConfig(max_distance=1e3, max_landmarks=10**6, max_frames=10**6)
    config = EkfSlamConfig(landmark=LandmarkConfig(probation_frames=4), submap=one_submap)
    slam = EkfSlam(config, T_RIG_OPTICAL)
    for k, T in enumerate(loop(30, 10.0, turns=0.3)):
        real, _ = world.features(T, (k + 1) * 10**8, rng, max_features=120)
        part = type(phantoms)(phantoms.points[200 * (k // 2) :][:200], phantoms.descriptors[200 * (k // 2) :][:200])
        false, _ = part.features(T, (k + 1) * 10**8, rng, max_features=60)
        fields = ("xyz", "uv", "depth", "sigma_uv", "sigma_depth", "response", "source", "descriptors")
        both = {name: np.concatenate([getattr(real, name), getattr(false, name)]) for name in fields}
        slam.process(type(real)(stamp_ns=real.stamp_ns, camera=real.camera, **both))
    (last,) = slam.finish()[-1:]
    real = (last.descriptors @ world.descriptors.T).max(axis=1) > 0.7
    assert real.sum() > 60
    assert real.mean() > 0.7  # those of the last frames are still on probation; without removal 0.4


def test_the_conditional_start_is_the_map_given_the_pose(rng):
    """Against the textbook formula on the dense covariance, rotated into the rig's frame."""
    n = 5
    A = rng.standard_normal((CORE_DIM + 3 * n, 60))
    P = A @ A.T
    ekf = Ekf(rng.standard_normal(6), P.copy(), True, rng.standard_normal((n, 3)))
    ekf.T = make_transform(rotation_from_euler(0.4, -0.2, 0.3), np.array([0.3, -0.5, 0.2]))
    slots = np.array([3, 1])
    rows = np.r_[6:CORE_DIM, (CORE_DIM + 3 * slots[:, None] + np.arange(3)).ravel()]
    P = ekf.covariance.dense()
    given = P[np.ix_(rows, rows)] - P[np.ix_(rows, range(6))] @ np.linalg.solve(P[:6, :6], P[np.ix_(range(6), rows)])
    R = ekf.T[:3, :3]
    turn = np.eye(len(rows))
    for k in range(len(slots)):
        at = slice(CORE_DIM - 6 + 3 * k, CORE_DIM - 6 + 3 * k + 3)
        turn[at, at] = R.T
    start = ekf.given_pose(slots)
    np.testing.assert_allclose(start.covariance.dense()[6:, 6:], turn @ given @ turn.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(start.covariance.dense()[:6], 0.0, atol=1e-12)
    np.testing.assert_allclose(start.landmarks, (ekf.landmarks[slots] - ekf.T[:3, 3]) @ R)


def test_every_algorithm_pairs_what_is_the_same(rng):
    """Each bare algorithm, without the linker that would find the pairs by looks alone."""
    world = room(rng, 400)
    views = [world.features(np.eye(4), k, rng, max_features=80) for k in (1, 2)]
    (before, first), (now, second) = [(frame_from_features(f, np.arange(len(f)), 0.01, 1e-5), i) for f, i in views]
    candidates = Candidates(*rig_points(before, T_RIG_OPTICAL), before.descriptors, before.tracks)
    config, covariance = FeatureAssociationConfig(), 1e-4 * np.eye(6)
    common = len(np.intersect1d(first, second))
    for associate, share in ((associate_mahalanobis, 0.95), (associate_jcbb, 0.2), (associate_ccda, 0.2)):
        rows, columns = associate(candidates, now, np.eye(4), covariance, T_RIG_OPTICAL, config)
        assert (first[rows] == second[columns]).mean() > 0.99
        assert len(rows) >= share * common
    rows, columns = associate_nearest(candidates, now, np.eye(4), T_RIG_OPTICAL, config)
    assert (first[rows] == second[columns]).mean() > 0.8  # by distance alone
    assert len(rows) >= 0.3 * common
