# SPDX-License-Identifier: Apache-2.0
"""What is usable of positions, which submap each is of, and what becomes of the others."""

from __future__ import annotations

import numpy as np
import pytest
from positioned_world import drive

from sjsam_node.positions.antenna import seen_inside, with_antenna
from sjsam_node.positions.position_queue import FAR, LATE, ODD, UNUSABLE, PositionConfig, PositionQueue
from slam_core.geometry import skew
from slam_core.types import PositionReading, Submap

GOOD = 0.01 * np.eye(3)


@pytest.fixture(scope="module")
def submaps() -> list[Submap]:
    return drive(1).submaps()[:3]


def at(stamp_ns: int, covariance: np.ndarray = GOOD, place: tuple[float, ...] = (1.0, 2.0, 3.0)) -> PositionReading:
    return PositionReading(stamp_ns, np.array(place), covariance)


@pytest.mark.parametrize(
    "covariance",
    [np.zeros((3, 3)), np.full((3, 3), np.nan), 1e6 * np.eye(3), np.diag([0.01, 0.01, -0.01]), GOOD + np.eye(3, k=1)],
    ids=["zero", "nan", "huge", "negative", "not symmetric"],
)
def test_a_position_without_a_usable_covariance_is_counted(submaps: list[Submap], covariance: np.ndarray) -> None:
    queue = PositionQueue(0)
    queue.add("a", at(submaps[0].end_stamp_ns, covariance))
    assert queue.take(submaps[0]) == ()
    assert queue.counters.counts == {UNUSABLE: 1}


def test_positions_far_from_their_origin_are_counted(submaps: list[Submap]) -> None:
    queue = PositionQueue(0)
    queue.add("a", at(submaps[0].end_stamp_ns, place=(4.5e5, 5.4e6, 30.0)))
    assert queue.counters.counts == {FAR: 1}


def test_each_submap_gets_its_own_and_its_end_but_not_its_start(submaps: list[Submap]) -> None:
    queue, first, second = PositionQueue(0), submaps[0], submaps[1]
    stamps = [first.start_stamp_ns, first.start_stamp_ns + 1, first.end_stamp_ns, first.end_stamp_ns + 1]
    for stamp in stamps:
        queue.add("a", at(stamp))
        queue.add("b", at(stamp))
    assert [r.stamp_ns for r in queue.take(first)] == stamps[1:3]
    assert [r.stamp_ns for r in queue.take(second)] == stamps[3:]
    assert queue.counters.counts == {LATE: 1}


def test_of_positions_close_in_time_one_counts(submaps: list[Submap]) -> None:
    queue, start = PositionQueue(200_000_000), submaps[0].start_stamp_ns
    for k in range(1, 9):
        queue.add("a", at(start + k * 100_000_000))
    assert [r.stamp_ns - start for r in queue.take(submaps[0])] == [k * 100_000_000 for k in (1, 3, 5, 7)]


def test_an_interval_goes_on_where_a_submap_ends(submaps: list[Submap]) -> None:
    queue, end = PositionQueue(200_000_000), submaps[0].end_stamp_ns
    queue.add("a", at(end))
    assert [r.stamp_ns for r in queue.take(submaps[0])] == [end]
    for k in (1, 2):
        queue.add("a", at(end + k * 100_000_000))
    assert [r.stamp_ns for r in queue.take(submaps[1])] == [end + 200_000_000]
    queue.clear()
    queue.add("a", at(end))
    assert [r.stamp_ns for r in queue.take(submaps[0])] == [end]


def test_after_a_jump_back_in_time_all_begins_anew(submaps: list[Submap]) -> None:
    queue, first, later = PositionQueue(0), submaps[0].start_stamp_ns, submaps[0].start_stamp_ns + 10**11
    for start in (later, first):
        for k in range(1, 4):
            queue.add("a", at(start + k * 100_000_000))
    assert [r.stamp_ns - first for r in queue.take(submaps[0])] == [k * 100_000_000 for k in range(1, 4)]
    assert queue.counters.counts == {LATE: 3}


def test_a_single_odd_stamp_is_rejected_and_all_else_stays(submaps: list[Submap]) -> None:
    queue, start = PositionQueue(0), submaps[0].start_stamp_ns
    for k in (10, 20, 19, 20, 10**6, 30, 40):  # out of order, twice, far ahead
        queue.add("a", at(start + k * 10_000_000))
    assert [(r.stamp_ns - start) // 10_000_000 for r in queue.take(submaps[0])] == [10, 20, 30, 40]
    assert queue.counters.counts == {ODD: 3}


def test_a_lever_arm_has_three_numbers() -> None:
    with pytest.raises(ValueError, match="three numbers"):
        PositionConfig(lever_arm=(1.0, 2.0))


def test_the_antenna_is_where_the_submap_has_it_with_its_covariance(submaps: list[Submap]) -> None:
    submap, arm = submaps[1], np.array([0.3, -0.1, 0.2])
    middle = submap.path[4].stamp_ns
    readings = seen_inside(submap, [at(middle), at(submap.end_stamp_ns), at(submap.end_stamp_ns + 1)])
    assert [r.stamp_ns for r in readings] == [middle, submap.end_stamp_ns]
    made = with_antenna(submap, readings, arm)
    n = len(submap.landmarks)
    np.testing.assert_allclose(made.landmarks[n], submap.path[4].T[:3, :3] @ arm + submap.path[4].T[:3, 3])
    np.testing.assert_allclose(made.landmarks[n + 1], submap.end_pose[:3, :3] @ arm + submap.end_pose[:3, 3])
    assert np.linalg.eigvalsh(made.covariance)[0] > 0.0
    # At the end of the submap the antenna errs as the end does, and by a millimetre.
    J = np.concatenate([np.eye(3), -skew(submap.end_pose[:3, :3] @ arm)], axis=1)
    wanted = J @ submap.covariance[:6, :6] @ J.T + 1e-6 * np.eye(3)
    np.testing.assert_allclose(made.covariance[-3:, -3:], wanted, atol=1e-9)
    np.testing.assert_allclose(made.covariance[-3:, :6], J @ submap.covariance[:6, :6], atol=1e-9)
