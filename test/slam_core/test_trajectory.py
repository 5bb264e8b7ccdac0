# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: exact stamps, formats, and what is said of broken ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam_core.geometry import boxplus, invert_transform
from slam_core.trajectory import (
    Trajectory,
    read_covariance_csv,
    read_trajectory,
    write_covariance_csv,
    write_tum,
)
from slam_core.types import PoseEstimate


def make_trajectory(rng, n=5):
    P = np.array([np.diag(rng.uniform(1e-6, 1e-2, 6)) + 1e-7 for _ in range(n)])
    poses = boxplus(np.tile(np.eye(4), (n, 1, 1)), rng.normal(size=(n, 6)))
    return Trajectory(1403715273262142976 + np.arange(n, dtype=np.int64) * 50_000_001, poses, P)


def test_tum_and_covariance_round_trip(rng, tmp_path):
    trajectory = make_trajectory(rng)
    write_tum(tmp_path / "t.tum", trajectory)
    write_covariance_csv(tmp_path / "t.csv", trajectory)
    read = read_trajectory(tmp_path / "t.tum")
    stamps, covariances = read_covariance_csv(tmp_path / "t.csv")
    np.testing.assert_array_equal(read.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(stamps, trajectory.stamps_ns)
    np.testing.assert_allclose(read.poses, trajectory.poses, atol=5e-9)
    np.testing.assert_allclose(covariances, trajectory.covariances, rtol=1e-8, atol=1e-16)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.csv", "t.tum"]


def test_kitti_and_euroc_formats(tmp_path):
    (tmp_path / "kitti.txt").write_text("1 0 0 1 0 1 0 2 0 0 1 3\n0 -1 0 4 1 0 0 5 0 0 1 6\n")
    kitti = read_trajectory(tmp_path / "kitti.txt")
    np.testing.assert_allclose(kitti.poses[:, :3, 3], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(kitti.poses[1, :2, :2], [[0, -1], [1, 0]], atol=1e-12)
    row = "1403715273262142976,1,2,3,0.6,0,0.8,0" + ",0" * 9
    (tmp_path / "data.csv").write_text("#timestamp,p\n" + row + "\n")
    euroc = read_trajectory(tmp_path / "data.csv")
    assert euroc.stamps_ns[0] == 1403715273262142976
    np.testing.assert_allclose(euroc.poses[0, :3, 0], [1 - 2 * 0.64, 0, -2 * 0.8 * 0.6], atol=1e-12)


@pytest.mark.parametrize("text", ["", "# only a comment\n", "1 2 3\n", "1 2 3 4 0 0 0 nan\n", "a b c d e f g h\n"])
def test_broken_files_are_refused_with_their_name(tmp_path, text):
    path = tmp_path / "broken.tum"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"broken\.tum"):
        read_trajectory(path)


def test_from_estimates_sorts_and_keeps_the_last_of_equal_stamps():
    T = np.stack([boxplus(np.eye(4), np.full(6, 0.1 * i)) for i in range(3)])
    estimates = [PoseEstimate(stamp, T[i], np.eye(6)) for i, stamp in enumerate((20, 10, 20))]
    trajectory = Trajectory.from_estimates(estimates)
    np.testing.assert_array_equal(trajectory.stamps_ns, [10, 20])
    np.testing.assert_array_equal(trajectory.poses, T[[1, 2]])
    assert len(Trajectory.from_estimates([])) == 0


def test_interpolation_is_exact_for_a_constant_screw_free_motion():
    step = np.array([0.1, 0.2, 0.3, 0.05, -0.1, 0.2])
    poses = np.stack([boxplus(np.eye(4), k * step) for k in range(3)])
    trajectory = Trajectory(np.array([0, 100, 200], dtype=np.int64), poses)
    got = trajectory.interpolate(np.array([50, 100, 175]))
    want = np.stack([boxplus(np.eye(4), k * step) for k in (0.5, 1.0, 1.75)])
    np.testing.assert_allclose(invert_transform(want) @ got, np.tile(np.eye(4), (3, 1, 1)), atol=1e-9)


def test_truth_in_nanoseconds_with_eight_columns_is_read_as_euroc_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("#timestamp [ns],x,y,z,qw,qx,qy,qz\n1403636579763555584,1,2,3,1,0,0,0\n")
    read = read_trajectory(path)
    assert read.stamps_ns.tolist() == [1403636579763555584]
    np.testing.assert_array_equal(read.poses[0, :3, :3], np.eye(3))
    path.write_text("1e30 1 2 3 0 0 0 1\n")
    with pytest.raises(ValueError, match="line 1"):
        read_trajectory(path)
