# SPDX-License-Identifier: Apache-2.0
"""A frame waits for every stream that lives, for none that is silent, and again for one that has come back."""

from __future__ import annotations

import pytest

from slam_core.nodes.awaited_streams import AwaitedStreams


def frames(streams: AwaitedStreams, stamps: range) -> list[bool]:
    """For each frame, as it comes, whether it has to wait."""
    waiting = []
    for stamp in stamps:
        streams.frame(stamp)
        waiting.append(streams.must_wait(stamp))
    return waiting


def test_a_frame_waits_until_every_stream_has_reached_its_stamp() -> None:
    streams = AwaitedStreams(["motion", "imu"])
    streams.frame(100)
    streams.heard("motion", 100)
    streams.heard("imu", 99)
    assert streams.must_wait(100)
    streams.heard("imu", 101)
    assert not streams.must_wait(100)
    assert streams.diagnostic() == ""


@pytest.mark.parametrize(("offset", "enough"), [(20, 80), (-20, 120)])
def test_stamps_of_another_clock_are_waited_for_by_that_clock(offset: int, enough: int) -> None:
    streams = AwaitedStreams(["imu"])
    streams.set_time_offset("imu", offset)
    streams.frame(100)
    streams.heard("imu", enough - 1)
    assert streams.must_wait(100)
    streams.heard("imu", enough)
    assert not streams.must_wait(100)


def test_a_stream_that_is_never_heard_holds_up_no_more_frames_than_the_patience() -> None:
    streams = AwaitedStreams(["motion"], patience=3)
    assert frames(streams, range(5)) == [True, True, True, False, False]
    assert streams.diagnostic() == "no motion so far"


def test_an_unexpected_stream_is_waited_for_once_it_was_heard() -> None:
    streams = AwaitedStreams()
    streams.frame(0)
    assert not streams.must_wait(0)
    streams.heard("imu", 0)
    streams.frame(10)
    assert streams.must_wait(10)


def test_a_stream_that_comes_back_is_waited_for_again() -> None:
    streams = AwaitedStreams(["motion"], patience=2)
    streams.heard("motion", 2_000_000_000)
    frames(streams, range(3_000_000_000, 3_000_000_004))
    assert streams.diagnostic() == "no motion since 2.000 s"
    streams.heard("motion", 3_000_000_003)
    streams.frame(3_000_000_010)
    assert streams.must_wait(3_000_000_010)
    assert streams.silent == ()


def test_a_stream_that_stays_behind_counts_as_silent() -> None:
    streams = AwaitedStreams(["motion"], patience=2)
    for stamp in range(10):
        streams.frame(stamp)
        streams.heard("motion", stamp - 5)
    assert streams.silent == ("motion",)


def test_a_stream_given_up_by_the_clock_is_not_waited_for_until_it_is_heard() -> None:
    streams = AwaitedStreams(["motion", "imu"])
    streams.frame(5)
    streams.heard("imu", 5)
    assert streams.give_up(5) == ("motion",)
    assert not streams.must_wait(5)
    streams.frame(6)
    streams.heard("imu", 6)
    assert not streams.must_wait(6)
    streams.heard("motion", 5)
    assert streams.must_wait(6)
