# SPDX-License-Identifier: Apache-2.0
"""An agent and a post over a bad channel: all arrives, in order, once, within the budget."""

from __future__ import annotations

import numpy as np
import pytest
from radio_world import World

from slam_core.health import State
from slam_radio.packing.light_submap import pack
from slam_radio.wire.link_report import Backlog, pack_backlog
from slam_radio.wire.radio_messages import pack_submap


@pytest.fixture
def world(tmp_path, make_submap):
    return World(tmp_path, make_submap)


def test_over_a_good_link_each_submap_goes_out_once_oldest_first(world):
    world.run(5.0)
    for index in range(12):
        world.submap(index)
    world.run(20.0)
    assert world.keys == world.passed_on == list(range(12))
    assert not world.uplink.outbox.waiting
    assert world.uplink.state(world.now_s).state is State.OK
    assert not list((world.folder / "out").glob("*.submap"))
    assert len(list((world.folder / "in").glob("*.submap"))) == 12


def test_a_fifth_of_all_messages_may_be_lost(world, rng):
    world.arrives = lambda to_post, now_s: bool(rng.random() > 0.2)
    for index in range(30):
        world.submap(index)
        world.run(2.0)
    world.run(120.0)
    assert world.passed_on == list(range(30))
    assert not world.uplink.outbox.waiting
    assert world.inbox.repeated < 0.25 * 30  # those whose acknowledgements were lost until the next one
    assert world.uplink.resent > 0


def test_in_silence_only_poses_go_out_and_then_everything(world):
    world.run(5.0)
    world.arrives = lambda to_post, now_s: not 5.0 < now_s < 65.0
    world.submap(0)
    world.run(20.0)
    for index in range(1, 6):
        world.submap(index)
    before = len(world.keys)
    world.run(39.0)
    assert len(world.keys) == before
    state = world.uplink.state(world.now_s)
    assert state.state is State.DEGRADED
    assert "the post silent for" in state.reason
    assert "6 submaps" in state.reason
    assert state.backlog_bytes == world.uplink.outbox.bytes_waiting > 0
    assert world.downlink.state(world.now_s).reason.startswith("one silent for")
    world.run(15.0)
    assert world.passed_on == list(range(6))


def test_the_newest_pose_goes_out_every_second_however_much_waits(world):
    world.uplink = type(world.uplink)(world.uplink.outbox, 300.0)
    for index in range(40):
        world.submap(index)
    world.run(60.0)
    assert len(world.poses) >= 55
    assert all(abs(stamp / 1e9 - now) < 1e-6 for now, stamp in world.poses)


def test_the_budget_is_never_exceeded(world, rng):
    world.arrives = lambda to_post, now_s: bool(rng.random() > 0.3)
    for index in range(60):
        world.submap(index)
    world.run(100.0)
    times, sizes = (np.array(part) for part in zip(*world.sent, strict=True))
    total = np.concatenate([[0], np.cumsum(sizes)])
    for first in range(len(times)):
        spans = times[first:] - times[first]
        assert (total[first + 1 :] - total[first] <= 2000.0 * (spans + 2.0) + sizes.max()).all()
    assert total[-1] > 0.5 * min(2000.0 * 100.0, sum(sizes))


def test_restarts_of_either_side_lose_nothing_and_send_nothing_twice(world):
    world.run(4.0)
    for index in range(12):
        world.submap(index)
    world.run(1.5)
    sent_before = set(world.passed_on)
    assert 0 < len(sent_before) < 12
    world.start_agent()
    for index in sorted(sent_before):
        assert world.uplink.outbox.knows((2, index))
    assert world.start_post() == sorted(sent_before)
    world.run(30.0)
    assert sorted(world.passed_on) == list(range(12))
    assert len(world.keys) <= 12 + 4  # what was under way when the agent was started anew
    assert world.start_post() == list(range(12))


def test_a_submap_behind_a_gap_waits_for_it(world, make_submap):
    def message(index, floor):
        return pack_submap(floor, pack(make_submap(5, index=index)))

    take = world.downlink.on_submap
    assert [s.index for s in take("one", (2, 0), message(0, 0), 0.0)] == [0]
    assert take("one", (2, 2), message(2, 1), 0.1) == []
    assert world.inbox.held == 1
    assert [s.index for s in take("one", (2, 1), message(1, 1), 0.2)] == [1, 2]
    # 3 will never come: its agent has nothing below 4 any more
    assert [s.index for s in take("one", (2, 4), message(4, 4), 0.3)] == [4]
    assert world.start_post() == [0, 1, 2, 4]


def test_what_was_acknowledged_is_not_taken_again_after_reset(world):
    world.run(4.0)
    world.submap(0)
    world.run(5.0)
    world.inbox.forget()
    assert not list((world.folder / "in").glob("*.submap"))
    assert world.uplink.outbox.knows((2, 0))
    assert world.start_post() == []


def test_too_much_for_the_link_is_said(world):
    world.run(4.0)
    for index in range(300):
        world.submap(index)
        world.run(0.3)
    state = world.uplink.state(world.now_s)
    assert state.state is State.DEGRADED
    assert "more comes in" in state.reason
    assert state.backlog_s > 30.0


def test_after_a_silence_any_message_of_the_post_has_submaps_go_out_again_soon(world):
    """A correction may be the first; a submap that was tried four times would wait for 40 s."""
    world.run(5.0)
    world.arrives = lambda to_post, now_s: not to_post
    world.submap(0)
    world.run(39.0)
    assert world.keys == [0] * 4
    world.uplink.on_heard(world.now_s + 20.0)
    assert world.uplink.ready(world.now_s + 24.0) is None
    assert world.uplink.ready(world.now_s + 25.0) == (2, 0)


def test_what_a_silent_agent_said_of_its_link_is_not_repeated(world):
    world.downlink.on_backlog("one", pack_backlog(Backlog(9, 900, 9.0, 90.0, 50.0, True)), 0.0)
    assert "more comes in at one" in world.downlink.state(1.0).reason
    assert world.downlink.state(60.0).reason == "one silent for 60 s"


def test_damaged_submaps_are_refused_and_not_acknowledged(world, make_submap, rng):
    light = pack(make_submap(5, index=0))
    data = pack_submap(0, light)
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.integers(4, len(data))] ^= int(rng.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            world.downlink.on_submap("one", (2, 0), bytes(damaged), 0.0)
    for key in ((2, 1), (3, 0)):
        with pytest.raises(ValueError, match="came as"):
            world.downlink.on_submap("one", key, data, 0.0)
    with pytest.raises(ValueError, match="came as"):
        world.downlink.on_submap("one", (2, 0), pack_submap(1, light), 0.0)
    assert world.inbox.acknowledgement() == []


def test_files_of_others_stay(world, tmp_path):
    folder = tmp_path / "out"
    strangers = {"2-7.submap": b"not one of ours", "notes.txt": b"mine"}
    for name, data in strangers.items():
        (folder / name).write_bytes(data)
    world.submap(0)
    world.start_agent()
    assert world.uplink.outbox.strangers == {tmp_path / "out": 1}
    assert world.uplink.outbox.waiting == [(2, 0)]
    with pytest.raises(ValueError, match="move it away"):
        world.submap(7)
    world.run(10.0)
    assert not world.uplink.outbox.waiting
    for name, data in strangers.items():
        assert (folder / name).read_bytes() == data


def test_one_process_keeps_the_outbox(world):
    with pytest.raises(ValueError, match="in use by another process"):
        type(world.uplink.outbox)(world.folder / "out")


def test_a_lost_submap_goes_out_again_as_soon_as_a_later_one_has_come(world):
    world.run(4.0)
    world.arrives = lambda to_post, now_s: not to_post
    world.submap(0)
    world.run(0.2)
    world.arrives = lambda to_post, now_s: True
    world.submap(1)
    world.run(1.0)
    assert world.keys == [0, 1, 0]
    assert world.passed_on == [0, 1]
    assert world.uplink.resent == 1


def test_a_submap_that_went_out_twice_says_nothing_about_those_before_it(world):
    """The acknowledgement of its first copy may have been late: what went out between is not lost."""
    world.run(4.0)
    world.arrives = lambda to_post, now_s: to_post
    world.submap(0)
    world.run(5.0)
    world.submap(1)
    world.run(1.5)
    assert world.keys == [0, 1, 0]
    world.uplink.on_acknowledgement([(2, 0, 1)], world.now_s)
    assert world.uplink.ready(world.now_s) is None
    world.uplink.on_acknowledgement([(2, 0, 2)], world.now_s)
    assert not world.uplink.outbox.waiting
