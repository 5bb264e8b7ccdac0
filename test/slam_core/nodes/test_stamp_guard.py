# SPDX-License-Identifier: Apache-2.0
"""Which stamps are outliers, gaps and jumps: by properties over random streams."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from slam_core.nodes.stamp_guard import CONFIRMATIONS, LONGEST_STEP_NS, StampGuard

MS = 1_000_000
HOUR = 3600 * 10**9
START = 1_700_000_000 * 10**9

steps = st.lists(st.integers(1 * MS, 300 * MS), min_size=4, max_size=30)
stamps = st.integers(0, 2**31 * 10**9)


def stream(steps: list[int], start: int = START) -> list[int]:
    out = [start]
    for step in steps:
        out.append(out[-1] + step)
    return out


class Listener:
    """What came through a guard."""

    def __init__(self) -> None:
        self.guard = StampGuard[int]()
        self.released: list[int] = []
        self.rejected: list[int] = []

    def hear(self, *stamps: int, name: str = "left", starts: bool = True) -> None:
        for stamp in stamps:
            ruling = self.guard.add(name, stamp, stamp, starts_sessions=starts)
            assert all(stamp == item for stamp, item in ruling.released)
            self.released += [stamp for stamp, _ in ruling.released]
            self.rejected += ruling.rejected


@given(steps)
def test_a_stream_in_order_passes_as_it_is(steps: list[int]) -> None:
    heard = Listener()
    heard.hear(*stream(steps))
    assert (heard.released, heard.rejected, heard.guard.session) == (stream(steps), [], 0)


@given(steps, st.data(), stamps)
def test_one_odd_stamp_is_rejected_and_nothing_else_changes(steps: list[int], data: st.DataObject, odd: int) -> None:
    good = stream(steps)
    at = data.draw(st.integers(2, len(good) - 2))
    heard = Listener()
    heard.hear(*good[:at], odd, *good[at:])
    assert heard.guard.session == 0
    step = odd - good[at - 1]
    if 0 <= step <= max(LONGEST_STEP_NS, 3 * (good[at - 1] - good[at - 2])):
        return  # cannot be told from the stream's next
    assert heard.released == good
    assert heard.rejected == [odd]


@given(steps, st.integers(2 * 10**9, 100 * HOUR), steps)
def test_a_gap_loses_nothing_and_begins_no_session(steps: list[int], gap: int, after: list[int]) -> None:
    good = stream(steps)
    later = stream(after, good[-1] + gap)
    heard = Listener()
    heard.hear(*good, *later)
    assert (heard.released, heard.rejected, heard.guard.session) == (good + later, [], 0)


@given(steps, st.integers(10 * 10**9, 100 * HOUR), steps)
def test_a_lasting_jump_back_begins_one_session_and_loses_nothing(
    steps: list[int], back: int, after: list[int]
) -> None:
    good = stream(steps)
    again = stream(after, good[-1] - back)
    heard = Listener()
    heard.hear(*good, *again)
    assert (heard.released, heard.rejected, heard.guard.session) == (good + again, [], 1)


@given(steps, st.lists(stamps, min_size=1, max_size=2), st.data())
def test_what_is_not_confirmed_begins_no_session(steps: list[int], odd: list[int], data: st.DataObject) -> None:
    assert len(odd) < CONFIRMATIONS
    good, heard = stream(steps), Listener()
    at = data.draw(st.integers(2, len(good) - 1))
    heard.hear(*good[:at], *odd, *good[at:])
    assert heard.guard.session == 0


@settings(max_examples=200)
@given(st.lists(stamps, min_size=1, max_size=60))
def test_whatever_comes_order_is_kept_within_a_session_and_every_message_is_accounted_for(noise: list[int]) -> None:
    guard, released, rejected, newest = StampGuard[int](), 0, 0, -1
    for stamp in noise:
        ruling = guard.add("left", stamp, stamp)
        newest = -1 if ruling.new_session else newest
        for accepted, _ in ruling.released:
            assert accepted >= newest
            newest = accepted
        released, rejected = released + len(ruling.released), rejected + len(ruling.rejected)
    assert len(noise) - CONFIRMATIONS < released + rejected <= len(noise)


def test_a_late_message_is_rejected_alone() -> None:
    heard = Listener()
    heard.hear(START, START + 100 * MS, START + 95 * MS, START + 200 * MS)
    assert heard.rejected == [START + 95 * MS]


def test_a_slow_stream_is_heard() -> None:
    slow = stream([15 * 10**9] * 10)
    heard = Listener()
    heard.hear(*slow)
    assert (heard.released, heard.rejected) == (slow, [])


def test_all_streams_of_a_rig_jump_into_one_session_though_one_lags() -> None:
    """The right images are four behind the left ones: their stragglers do not take the session back."""
    for back in (2 * 10**9, HOUR):
        old, new = stream([33 * MS] * 20), stream([33 * MS] * 20, START - back)
        left, right = old + new, old + new
        heard, late = Listener(), 4
        for k in range(len(left) + late):
            if k < len(left):
                heard.hear(left[k], name="left")
            if k >= late:
                heard.hear(right[k - late], name="right")
        assert heard.guard.session == 1
        assert heard.released.count(new[-1]) == 2
        assert len(heard.released) >= 2 * len(left) - 2 * CONFIRMATIONS


def test_what_accompanies_frames_begins_no_session_but_follows_them() -> None:
    heard = Listener()
    old, new = stream([10 * MS] * 50), stream([10 * MS] * 50, START - HOUR)
    heard.hear(*old[::5], name="left")
    heard.hear(*old, name="imu", starts=False)
    heard.hear(*new[:20], name="imu", starts=False)
    assert heard.guard.session == 0
    assert new[0] not in heard.released
    heard.hear(*new[::5], name="left")
    assert heard.guard.session == 1
    heard.hear(*new[20:], name="imu", starts=False)
    assert heard.released[-30:] == new[21:]


def test_a_first_stamp_that_was_odd_is_left_behind() -> None:
    heard = Listener()
    good = stream([33 * MS] * 10)
    heard.hear(START + HOUR, name="right")
    heard.hear(*good, name="left")
    assert heard.released[1:] == good
