# SPDX-License-Identifier: Apache-2.0
"""Details on request: they come when they are asked for, once, after all submaps, and never make a submap surer."""

from __future__ import annotations

import errno
import struct
import zlib
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from radio_world import SIZE, World

from slam_core.types import Submap
from slam_radio.packing.light_submap import lightened, pack, write
from slam_radio.packing.submap_details import key_of_details, pack_details, with_details
from slam_radio.wire.radio_messages import MOST_RANGES


@pytest.fixture
def world(tmp_path, make_submap):
    return World(tmp_path, make_submap, landmarks=12)


def packed(submap: Submap) -> tuple[bytes, bytes]:
    light = lightened(submap, SIZE)
    message = write(light)
    details = pack_details(submap, light, message)
    assert details is not None
    return message, details


def test_nothing_goes_out_unasked_and_what_is_asked_for_goes_out_once(world):
    world.run(5.0)
    for index in range(4):
        world.submap(index)
    world.run(20.0)
    assert world.detail_keys == []
    assert world.inbox.ask([(2, 1), (2, 3), (9, 9)]) == 2
    world.run(20.0)
    assert world.detail_keys == [1, 3]
    assert [s.index for s in world.detailed] == [1, 3]
    assert world.inbox.wanted == set()
    assert world.inbox.ask() == 2
    world.run(20.0)
    assert sorted(world.detail_keys) == [0, 1, 2, 3]
    assert sorted(world.keys) == [0, 1, 2, 3]


def test_with_details_a_submap_has_all_landmarks_and_is_not_surer(make_submap):
    submap = make_submap(12)
    found = with_details(*packed(submap))
    assert sorted(found.landmark_ids) == sorted(submap.landmark_ids)
    rows = np.array([int(np.nonzero(submap.landmark_ids == i)[0][0]) for i in found.landmark_ids])
    unknowns = np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])
    L = np.linalg.inv(np.linalg.cholesky(found.covariance))
    assert np.linalg.eigvalsh(L @ submap.covariance[np.ix_(unknowns, unknowns)] @ L.T)[-1] <= 1.0
    np.testing.assert_allclose(found.landmarks, submap.landmarks[rows], atol=0.01)
    assert np.einsum("nd,nd->n", found.descriptors, submap.descriptors[rows]).min() > 0.99


def test_submaps_go_out_before_details(world):
    world.bytes_per_second = 1000.0
    world.start_agent()
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    world.inbox.ask()
    for index in range(1, 6):
        world.submap(index)
    world.run(1.0)
    assert world.detail_keys == []
    world.run(60.0)
    assert world.keys == list(range(6))
    assert world.detail_keys == [0]


def test_a_submap_that_is_not_acknowledged_yet_holds_details_back(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    world.uplink.details.want([(2, 0, 1)])
    world.submap(1)
    kinds = [[m.kind for m in world.uplink.due(world.now_s + k)] for k in (0.1, 0.2)]
    assert "submap" in kinds[0]
    assert not any("details" in sent for sent in kinds)
    world.uplink.on_acknowledgement([(2, 0, 2)], world.now_s + 0.3)
    assert [m.kind for m in world.uplink.due(world.now_s + 0.3)] == ["details"]


def test_a_silence_and_restarts_of_both_sides_lose_no_details_and_send_none_twice(world):
    world.run(5.0)
    for index in range(3):
        world.submap(index)
    world.run(15.0)
    world.arrives = lambda to_post, now_s: now_s > 80.0
    world.inbox.ask()
    world.run(30.0)
    assert world.detailed == []
    world.start_agent()
    assert world.start_post() == [0, 1, 2]
    assert len(world.inbox.wanted) == 3
    world.run(70.0)
    assert sorted(s.index for s in world.detailed) == [0, 1, 2]
    assert sorted(world.detail_keys) == [0, 1, 2]
    assert world.start_post() == [0, 1, 2]
    assert world.inbox.wanted == set()
    again = {s.index: len(s.landmarks) for s in [world.inbox._submap((2, k)) for k in range(3)]}
    assert again == {0: 12, 1: 12, 2: 12}


def test_after_a_silence_any_message_of_the_post_has_details_go_out_again_soon(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    world.arrives = lambda to_post, now_s: not to_post
    world.inbox.ask()
    world.run(39.0)
    assert world.detail_keys == [0] * 4
    world.uplink.on_heard(world.now_s + 20.0)
    assert world.uplink.details.ready(world.now_s + 24.0) is None
    assert world.uplink.details.ready(world.now_s + 25.0) == (2, 0)


def test_details_that_came_when_the_disk_was_full_are_passed_on_when_they_come_again(world, monkeypatch):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    world.inbox.ask()
    details = packed(world.whole(0))[1]
    with monkeypatch.context() as full:
        full.setattr("slam_radio.queues.inbox.write_ranges", Mock(side_effect=OSError(errno.ENOSPC, "disk full")))
        with pytest.raises(OSError, match="disk full"):
            world.inbox.take_details((2, 0), details)
    assert world.inbox.lacking() == [(2, 0, 1)]
    world.run(20.0)
    assert [len(s.landmarks) for s in world.detailed] == [12]
    assert world.inbox.wanted == set()
    assert world.inbox.take_details((2, 0), details) == []
    assert world.inbox.repeated == 1


def test_a_fifth_of_all_messages_may_be_lost(world, rng):
    world.arrives = lambda to_post, now_s: bool(rng.random() > 0.2)
    for index in range(10):
        world.submap(index)
    world.run(90.0)
    world.inbox.ask()
    world.run(180.0)
    assert sorted(s.index for s in world.detailed) == list(range(10))


def test_damaged_ones_and_those_of_another_message_are_refused_and_still_wanted(world, make_submap, rng):
    world.run(5.0)
    world.submap(1)
    world.run(10.0)
    world.inbox.ask()
    message, details = packed(world.whole(1))
    for _ in range(100):
        spoilt = bytearray(details)
        spoilt[rng.integers(len(details))] ^= int(rng.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            world.downlink.on_details("one", (2, 1), bytes(spoilt), world.now_s)
    with pytest.raises(ValueError, match="not of this submap"):
        with_details(message, packed(make_submap(13, seed=1, index=1))[1])
    with pytest.raises(ValueError, match="which is not here"):
        world.downlink.on_details("one", (2, 7), details, world.now_s)
    assert world.inbox.wanted == {(2, 1)}
    assert key_of_details(details) == (2, 1)


def test_forged_details_are_refused_or_of_a_submap(make_submap, rng):
    message, details = packed(make_submap(12))
    refused = 0
    for _ in range(300):
        forged = bytearray(details[7:])
        for at in rng.integers(len(forged), size=2):
            forged[at] = int(rng.integers(256))
        try:
            found = with_details(message, struct.pack("<2sBI", b"SD", 2, zlib.crc32(forged)) + forged)
        except ValueError:
            refused += 1
        else:
            np.linalg.cholesky(found.covariance)
    assert refused > 20


def test_a_submap_that_was_sent_whole_has_none(make_submap):
    submap = make_submap(5)
    light = lightened(submap, SIZE)
    assert pack_details(submap, light, write(light)) is None


def test_a_landmark_that_cannot_be_sent_costs_the_details_and_not_the_submap(world):
    world.run(5.0)
    submap = world.whole(0)
    left_out = int(np.flatnonzero(~np.isin(submap.landmark_ids, lightened(submap, SIZE).landmarks.ids))[0])
    covariance = submap.covariance.copy()
    own = slice(6 + 3 * left_out, 9 + 3 * left_out)
    covariance[own, own] += 1e12 * np.eye(3)
    world.uplink.details.store.keep((2, 0), replace(submap, covariance=covariance), pack(submap, SIZE))
    world.uplink.add_submap((2, 0), pack(submap, SIZE), world.now_s)
    world.submap(1)
    world.run(10.0)
    world.inbox.ask()
    world.run(20.0)
    assert world.passed_on == [0, 1]
    assert world.detail_keys == [1]
    assert world.told_none == [1]
    assert world.uplink.details.store.damaged == 1


def test_details_that_there_are_not_are_answered_once_and_not_asked_for_again(world):
    """Gone, damaged, or nothing was left out; with all others they are asked for once more."""
    world.run(5.0)
    for index in range(4):
        world.submap(index)
    world.run(20.0)
    world.uplink.details.store.whole.remove((2, 1))
    (world.uplink.details.store.whole.path / "2-2.npz").write_bytes(b"PK damaged")
    world.run(5.0)
    world.inbox.ask([(2, 1), (2, 2), (2, 3)])
    world.run(20.0)
    assert world.detail_keys == [3]
    assert sum(world.told_none) == 2
    assert world.inbox.wanted == set()
    answers, wants = len(world.told_none), world.wants
    assert world.inbox.ask([(2, 1), (2, 2)]) == 0
    world.run(20.0)
    assert (len(world.told_none), world.wants) == (answers, wants)
    assert world.start_post() == [0, 1, 2, 3]
    assert world.inbox.ask([(2, 1), (2, 2)]) == 0
    assert world.inbox.ask() == 3
    world.run(20.0)
    assert world.inbox.wanted == set()
    assert sorted(world.detail_keys) == [0, 3]
    assert (world.uplink.details.store.whole.path / "2-2.npz").read_bytes() == b"PK damaged"


def test_an_answer_that_is_lost_is_given_again(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    world.uplink.details.store.whole.remove((2, 0))
    world.arrives = lambda to_post, now_s: not (to_post and now_s < 25.0)
    world.inbox.ask()
    world.run(30.0)
    assert world.inbox.wanted == set()
    assert world.told_none == [1]


def test_details_are_packed_when_they_are_asked_for_and_the_whole_submap_goes(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    store = world.uplink.details.store
    assert (list(store.folder.sizes), list(store.whole.sizes)) == ([], [(2, 0)])
    world.start_agent()
    store = world.uplink.details.store
    world.inbox.ask()
    world.run(10.0)
    assert (list(store.folder.sizes), list(store.whole.sizes)) == ([(2, 0)], [])
    assert [len(s.landmarks) for s in world.detailed] == [12]
    assert not list(store.whole.path.iterdir())


def test_details_keep_to_the_speed_of_the_link(tmp_path, make_submap):
    """Of many that are wanted four seconds of the link are under way, and none goes out again while it may come."""
    world = World(tmp_path, make_submap, landmarks=60, bytes_per_second=400.0)
    world.run(5.0)
    for index in range(8):
        world.submap(index)
    world.run(60.0)
    world.arrives = lambda to_post, now_s: not to_post
    world.inbox.ask()
    began = world.now_s
    world.uplink.details.want(world.inbox.lacking())
    size = None
    times = []
    for _ in range(600):
        world.now_s += 0.1
        while (key := world.uplink.details.ready(world.now_s)) is not None:
            size = world.uplink.details.size(key)
            world.uplink.details.take(key, world.now_s)
            times.append((round(world.now_s - began, 1), key[1]))
    assert size is not None
    first = [t for t, _ in times if t < 5.0]
    assert len(first) == max(1, int(4.0 * 400.0 / size))
    again = [t for t, index in times if index == times[0][1]]
    assert again[1] - again[0] == pytest.approx(5.0 + size / 400.0, abs=0.2)


def test_details_whose_file_is_gone_are_left_out(world):
    world.run(5.0)
    for index in range(3):
        world.submap(index)
    world.run(20.0)
    for path in world.uplink.details.store.whole.path.iterdir():
        path.unlink()
    world.inbox.ask([(2, 1)])
    world.run(20.0)
    assert world.detail_keys == []
    assert world.inbox.wanted == set()


def test_packed_details_whose_file_is_gone_are_answered_too(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    details = world.uplink.details
    details.want([(2, 0, 1)])
    assert details.ready(world.now_s) == (2, 0)
    (details.store.folder.path / "2-0.submap").unlink()
    details.want([])
    world.inbox.ask()
    world.run(1.0)
    assert world.told_none == [1]
    assert world.inbox.wanted == set()


def test_many_that_an_agent_lacks_do_not_keep_others_waiting(world):
    """A message names 64 ranges; of more wanted ones others come each time."""
    world.run(5.0)
    scattered = range(0, 2 * (MOST_RANGES + 2), 2)
    for index in range(scattered[-1] + 1):
        world.submap(index)
    world.run(150.0)
    for index in scattered[:-1]:
        world.uplink.details.store.whole.remove((2, index))
    assert world.inbox.ask([(2, index) for index in scattered]) == len(scattered)
    world.run(30.0)
    assert world.detail_keys == [scattered[-1]]
    assert world.inbox.wanted == set()
