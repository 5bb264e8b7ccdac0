# SPDX-License-Identifier: Apache-2.0
"""Missing frames are counted by the stamps of those that came."""

from __future__ import annotations

import pytest

from slam_core.nodes.stamp_gaps import StampGaps


@pytest.mark.parametrize(("lost", "expected"), [((), 0), ((7,), 1), ((7, 8, 9), 3), ((6, 9, 12, 15), 4)])
def test_frames_that_did_not_come_are_counted(rng, lost, expected) -> None:
    gaps = StampGaps()
    for k in range(20):
        if k not in lost:
            gaps.add(1000 * k + int(rng.integers(-100, 100)) + 10_000)
    assert gaps.missing == expected


def test_a_new_session_is_no_gap() -> None:
    gaps = StampGaps()
    for stamp in (0, 10, 20, 30, 40):
        gaps.add(stamp)
    gaps.restart()
    assert [gaps.add(stamp) for stamp in (10_000, 10_010)] == [0, 0]
