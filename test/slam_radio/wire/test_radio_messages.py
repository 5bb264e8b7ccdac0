# SPDX-License-Identifier: Apache-2.0
"""The small messages come out as they went in, never surer; damaged ones are refused."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from slam_core.geometry import boxminus, boxplus
from slam_core.types import PoseEstimate
from slam_radio.queues.byte_budget import ByteBudget
from slam_radio.wire.index_ranges import IndexRanges, read_ranges, write_ranges
from slam_radio.wire.radio_messages import (
    MOST_RANGES,
    pack_acknowledgement,
    pack_correction,
    pack_pose,
    unpack_acknowledgement,
    unpack_correction,
    unpack_pose,
)


@pytest.mark.parametrize("seed", range(10))
def test_a_pose_has_30_bytes_and_covers_its_covariance(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 8)) * np.repeat([0.05, 0.01], 3)[:, None]
    T = boxplus(np.eye(4), np.concatenate([rng.uniform(-100, 100, 3), rng.uniform(-1.7, 1.7, 3)]))
    pose = PoseEstimate(1_700_000_000_123_456_789, T, A @ A.T)
    data = pack_pose(pose)
    assert len(data) == 30
    found = unpack_pose(data)
    assert found.stamp_ns == pose.stamp_ns
    np.testing.assert_allclose(boxminus(found.T, T), 0.0, atol=1e-4)
    assert np.linalg.eigvalsh(found.covariance - pose.covariance)[0] >= 0.0
    assert np.linalg.eigvalsh(found.covariance / 2.1 - np.diag(np.diag(found.covariance)) / 2.1)[0] >= 0.0
    assert np.trace(found.covariance[:3, :3]) < 2.1 * 3.0 * np.linalg.eigvalsh(pose.covariance[:3, :3])[-1]


def test_poses_that_cannot_be_are_refused():
    data = pack_pose(PoseEstimate(5, np.eye(4), 1e-4 * np.eye(6)))
    wrong = {8: np.float32(np.nan).tobytes(), 12: np.float32(1e9).tobytes(), 26: np.float16(np.inf).tobytes(),
             28: np.float16(0.0).tobytes(), 0: np.int64(-1).tobytes()}  # fmt: skip
    for at, part in wrong.items():
        with pytest.raises(ValueError, match=r"."):
            unpack_pose(data[:at] + part + data[at + len(part) :])
    with pytest.raises(ValueError, match="30 bytes"):
        unpack_pose(data[:-1])
    with pytest.raises(ValueError, match="too uncertain"):
        pack_pose(PoseEstimate(5, np.eye(4), 1e12 * np.eye(6)))


def test_a_correction_comes_out_as_it_went_in():
    T = boxplus(np.eye(4), np.array([3.0, -2.0, 0.5, 0.1, -0.2, 3.1]))
    stamp, found = unpack_correction(pack_correction(7, T))
    assert stamp == 7
    np.testing.assert_allclose(found, T, atol=1e-6)
    with pytest.raises(ValueError, match="32 bytes"):
        unpack_correction(b"")


def test_acknowledgements_and_damaged_ones(rng):
    ranges = [(1_700_000_000, 0, 12), (3, 4, 5)]
    data = pack_acknowledgement(ranges)
    assert unpack_acknowledgement(data) == ranges
    assert unpack_acknowledgement(pack_acknowledgement([])) == []
    assert len(unpack_acknowledgement(pack_acknowledgement([(k, 0, 1) for k in range(200)]))) == MOST_RANGES
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            unpack_acknowledgement(bytes(damaged))


def test_ranges_join_and_are_kept(tmp_path, rng):
    wanted = {(int(s), int(i)) for s, i in rng.integers(0, (3, 30), (60, 2))}
    ranges = IndexRanges()
    for key in wanted:
        ranges.add(key)
    write_ranges(tmp_path / "ranges.json", ranges)
    again = IndexRanges(read_ranges(tmp_path / "ranges.json"))
    assert {(s, i) for s in range(4) for i in range(40) if (s, i) in again} == wanted
    listed = list(again)
    assert listed == sorted(listed)
    assert all(a[0] != b[0] or a[2] < b[1] for a, b in pairwise(listed))
    (tmp_path / "ranges.json").write_text("[1]")
    with pytest.raises(ValueError, match="move it away"):
        read_ranges(tmp_path / "ranges.json")


def test_the_budget_saves_two_seconds_and_no_more():
    budget = ByteBudget(100.0)
    assert budget.allows(200, 0.0)
    budget.spend(200)
    assert not budget.allows(50, 0.4)
    assert budget.allows(50, 0.6)
    assert not budget.allows(150, 1.0)
    assert budget.allows(10_000, 100.0)
    budget.spend(10_000)
    assert not budget.allows(1, 190.0)
    assert budget.allows(1, 200.0)
