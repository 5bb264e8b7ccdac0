# SPDX-License-Identifier: Apache-2.0
"""Views on request over a bad channel: they come when they are asked for, last, each piece once, also after silence."""

from __future__ import annotations

import numpy as np
import pytest
from radio_world import World

from slam_radio.queues.byte_budget import OVERHEAD
from slam_radio.views.view_format import DENSE, PICTURE, PlacedImage, pack_view
from slam_radio.views.view_taker import encoded
from slam_radio.wire.view_messages import (
    PIECE_BYTES,
    WINDOW,
    Lack,
    ViewKey,
    pack_piece,
    pieces_of,
    unpack_piece,
)

SESSION = 2


@pytest.fixture
def world(tmp_path, make_submap):
    return World(tmp_path, make_submap)


def picture(stamp_ns: int, side: int = 64, seed: int = 1) -> PlacedImage:
    """A picture of noise: about one byte a pixel."""
    pixels = np.random.default_rng(seed).integers(0, 256, (side, side, 3), dtype=np.uint8)
    return PlacedImage(SESSION, 0, stamp_ns, 0, np.eye(4), (side, side), (0.0, 0.0, 0.0, 0.0), encoded(pixels, 80))


def keep(world: World, stamp_ns: int, **more) -> int:
    """Have the agent keep a picture; returns the number of its pieces."""
    data = pack_view(picture(stamp_ns, **more))
    world.uplink.views.files.add(ViewKey(PICTURE, SESSION, stamp_ns), data)
    return -(-len(data) // PIECE_BYTES)


def ask(world: World, stamp_ns: int, kind: int = PICTURE) -> PlacedImage | None:
    return world.views.ask(ViewKey(kind, SESSION, stamp_ns))


def test_nothing_goes_out_unasked_and_every_piece_of_what_is_asked_for_once(world):
    count = keep(world, 10**9)
    keep(world, 9 * 10**9)
    world.run(10.0)
    assert world.pieces == []
    assert ask(world, 11 * 10**8) is None
    world.run(30.0)
    assert count > 3
    assert sorted(world.pieces) == [(11 * 10**8, n) for n in range(count)]
    assert world.seen == [10**9]
    assert world.views.wanted == []
    found = world.views.files.read(ViewKey(PICTURE, SESSION, 10**9))[0]
    assert found.jpeg == picture(10**9).jpeg
    assert ask(world, 10**9 + 1).stamp_ns == 10**9  # it is there
    assert ask(world, 12 * 10**8) is None  # farther off: the agent says in one piece that it is the same image
    world.run(10.0)
    assert world.pieces[count:] == [(12 * 10**8, 0)]
    assert world.seen == [10**9, 10**9]


def test_two_moments_of_one_image_cost_one_piece_more(world):
    count = keep(world, 10**9)
    world.run(5.0)
    ask(world, 8 * 10**8)
    ask(world, 12 * 10**8)
    world.run(30.0)
    assert len(world.pieces) == count + 1
    assert world.seen == [10**9]
    assert world.views.wanted == []


def test_what_there_is_not_is_answered_so(world):
    keep(world, 10**9)
    world.run(5.0)
    ask(world, 4 * 10**9)
    ask(world, 10**9, DENSE)
    world.run(10.0)
    assert world.views.wanted == []
    assert world.pieces == []
    assert world.kinds.count("unseen") == 1


def test_a_damaged_file_is_answered_as_none_and_stays(world):
    keep(world, 10**9)
    file = next((world.folder / "shots").glob("*.view"))
    spoilt = bytearray(file.read_bytes())
    spoilt[-1] ^= 1
    file.write_bytes(spoilt)
    world.run(5.0)
    ask(world, 10**9)
    world.run(10.0)
    assert world.views.wanted == []
    assert world.uplink.views.damaged == 1
    assert file.read_bytes() == spoilt


def test_views_wait_for_submaps_and_details_and_keep_the_budget(world):
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    keep(world, 10**9, side=128)
    ask(world, 10**9)
    world.run(3.0)
    assert world.pieces
    before = len(world.pieces)
    for index in range(1, 30):
        world.submap(index)
    world.run(2.0)
    assert len(world.pieces) == before
    world.run(60.0)
    assert world.seen == [10**9]
    times, sizes = (np.array(part) for part in zip(*world.sent, strict=True))
    total = np.concatenate([[0], np.cumsum(sizes)])
    for first in range(len(times)):
        spans = times[first:] - times[first]
        assert (total[first + 1 :] - total[first] <= 2000.0 * (spans + 2.0) + sizes.max()).all()


def test_details_go_out_before_views(tmp_path, make_submap):
    world = World(tmp_path, make_submap, landmarks=12)
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    keep(world, 10**9)
    ask(world, 10**9)
    world.inbox.ask()
    world.run(10.0)
    sent = [kind for kind in world.kinds if kind in ("details", "piece")]
    assert sent[0] == "details"
    assert "piece" in sent


def test_a_silence_and_restarts_of_both_sides_send_no_piece_twice(world):
    count = keep(world, 10**9, side=128)
    world.run(5.0)
    ask(world, 10**9)
    world.run(4.0)
    assert 0 < len(world.pieces) < count
    world.run(0.9)
    world.arrives = lambda to_post, now_s: now_s > 80.0
    before = len(world.pieces)
    world.run(20.0)
    world.start_agent()
    world.start_post()
    assert world.views.wanted == [ViewKey(PICTURE, SESSION, 10**9)]
    world.run(100.0)
    assert world.seen == [10**9]
    lost = len(world.pieces) - count
    assert lost <= 4.0 * 2000.0 / (PIECE_BYTES + OVERHEAD) + 2  # what was under way when the silence began
    assert before < count
    assert not list((world.folder / "views" / "pieces").iterdir())


def test_a_fifth_of_all_messages_may_be_lost(world, rng):
    world.arrives = lambda to_post, now_s: bool(rng.random() > 0.2)
    stamps = [k * 10**10 for k in range(1, 5)]
    for stamp in stamps:
        keep(world, stamp, seed=stamp % 97)
        ask(world, stamp)
    world.run(240.0)
    assert sorted(world.seen) == stamps
    assert world.views.repeated < 0.5 * len(world.pieces)


def test_damaged_and_forged_pieces_are_refused_and_still_lacking(world, rng):
    world.run(5.0)
    ask(world, 10**9)
    key = ViewKey(PICTURE, SESSION, 10**9)
    data = pack_view(picture(10**9))
    pieces = pieces_of(key, 10**9, data)
    for _ in range(100):
        spoilt = bytearray(pack_piece(pieces[0]))
        spoilt[rng.integers(len(spoilt))] ^= int(rng.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            world.downlink.on_piece("one", bytes(spoilt), world.now_s)
    assert world.views.lacks() == [Lack(key)]
    broken = bytearray(data)
    broken[-3] ^= 1
    forged = pieces_of(key, 10**9, bytes(broken))  # its own checksum fits, that of the view does not
    for piece in forged[:-1]:
        assert world.views.take(pack_piece(piece)) is None
    with pytest.raises(ValueError, match="damaged"):
        world.views.take(pack_piece(forged[-1]))
    assert world.views.lacks() == [Lack(key)]
    with pytest.raises(ValueError, match="came as"):
        [world.views.take(pack_piece(p)) for p in pieces_of(key, 10**9, pack_view(picture(2 * 10**9)))]
    assert world.views.damaged == 2
    assert not world.views.files.sizes


def test_an_image_that_the_agent_has_replaced_comes_whole(world):
    world.run(5.0)
    ask(world, 10**9)
    key = ViewKey(PICTURE, SESSION, 10**9)
    for piece in pieces_of(key, 10**9, pack_view(picture(10**9, side=200)))[:6]:
        world.views.take(pack_piece(piece))
    count = keep(world, 10**9, side=40)
    assert count < 6
    world.run(30.0)
    assert world.seen == [10**9]
    assert world.views.files.read(key)[0].size == (40, 40)


def test_a_look_tells_the_pieces_that_have_come():
    key = ViewKey(PICTURE, SESSION, 5)
    lack = Lack.of(key, [0, 1, 3, 6, WINDOW + 7])
    assert (lack.first, lack.bits) == (2, 0b10010)
    assert [n for n in range(8) if lack.has(n)] == [0, 1, 3, 6]


def a_whole_one(world: World) -> None:
    """A picture is asked for and all its pieces come, but the disk is full as they are put together."""
    key = ViewKey(PICTURE, SESSION, 10**9)
    pieces = pieces_of(key, 10**9, pack_view(picture(10**9)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world.views.files, "add", full_disk)
        for piece in pieces[:-1]:
            world.views.take(pack_piece(piece))
        with pytest.raises(OSError, match="no space"):
            world.views.take(pack_piece(pieces[-1]))


def full_disk(*_):
    raise OSError("no space left on device")


def test_a_view_that_could_not_be_written_is_kept_with_the_next_piece(world):
    keep(world, 10**9)
    world.run(5.0)
    ask(world, 10**9)
    a_whole_one(world)
    world.run(10.0)
    assert world.seen == [10**9]
    assert world.views.wanted == []
    assert len(world.pieces) == 1


def test_a_view_that_was_whole_when_the_post_ended_is_there_after_a_restart(world):
    ask(world, 10**9)
    ask(world, 3 * 10**9)
    a_whole_one(world)
    world.start_post()
    assert [view.stamp_ns for view in world.views.finished] == [10**9]
    assert world.views.wanted == [ViewKey(PICTURE, SESSION, 3 * 10**9)]
    assert ask(world, 10**9).stamp_ns == 10**9
    world.start_post()
    assert world.views.finished == []


def test_a_view_in_whose_place_a_strange_file_is_is_wanted_no_more(world):
    keep(world, 10**9)
    world.run(5.0)
    ask(world, 10**9)
    (world.folder / "views" / f"{PICTURE}-{SESSION}-{10**9}.view").write_bytes(b"another")
    pieces = pieces_of(ViewKey(PICTURE, SESSION, 10**9), 10**9, pack_view(picture(10**9)))
    for piece in pieces[:-1]:
        world.views.take(pack_piece(piece))
    with pytest.raises(ValueError, match="move it away"):
        world.views.take(pack_piece(pieces[-1]))
    assert world.views.wanted == []
    assert not list((world.folder / "views" / "pieces").iterdir())


def test_old_requests_that_nobody_answers_do_not_keep_a_new_one_waiting(world):
    for k in range(90):
        ask(world, k * 10**11)
    keep(world, 10**9)
    ask(world, 10**9)
    assert len(world.views.wanted) == 64
    assert world.views.given_up == 27
    world.uplink.views.unseen = lambda: None  # an agent that does not answer what it lacks
    world.run(30.0)
    assert world.seen == [10**9]
    assert len(world.views.wanted) == 63


def test_what_an_agent_does_not_answer_for_half_an_hour_is_given_up(world):
    ask(world, 10**9)
    world.arrives = lambda to_post, now_s: not to_post
    world.run(60.0)
    assert world.looks == 0  # it is not heard: that does not count
    for _ in range(599):
        world.views.count_look()
    world.views.give_up([])  # an answer
    for _ in range(599):
        world.views.count_look()
    assert len(world.views.wanted) == 1
    world.arrives = lambda to_post, now_s: True
    world.uplink.views.unseen = lambda: None
    world.run(10.0)
    assert world.looks > 0
    assert world.views.wanted == []
    assert world.views.given_up == 1


def test_pieces_of_before_that_are_damaged_or_not_wanted_are_dropped_at_the_start(world):
    ask(world, 10**9)
    key = ViewKey(PICTURE, SESSION, 10**9)
    for piece in pieces_of(key, 10**9, pack_view(picture(10**9)))[:3]:
        world.views.take(pack_piece(piece))
    files = sorted((world.folder / "views" / "pieces").iterdir())
    files[1].write_bytes(files[1].read_bytes()[:-5])
    other = pack_piece(pieces_of(key._replace(session=9), 10**9, b"other")[0])
    (files[0].parent / "1-9-1000000000-0.piece").write_bytes(other)
    world.start_post()
    assert world.views.lacks() == [Lack(key, 1, 0b10)]
    assert len(list(files[0].parent.iterdir())) == 2
    assert unpack_piece(files[0].read_bytes()).number == 0


def test_a_submap_that_is_not_acknowledged_yet_holds_views_back(world):
    keep(world, 10**9)
    world.run(5.0)
    world.uplink.views.lack([Lack(ViewKey(PICTURE, SESSION, 10**9))], world.now_s)
    world.submap(1)
    kinds = [[m.kind for m in world.uplink.due(world.now_s + k)] for k in (0.1, 0.2)]
    assert "submap" in kinds[0]
    assert not any("piece" in sent for sent in kinds)
    world.uplink.on_acknowledgement([(2, 0, 2)], world.now_s + 0.3)
    assert "piece" in [m.kind for m in world.uplink.due(world.now_s + 0.3)]


def test_details_that_the_budget_does_not_allow_yet_hold_views_back(tmp_path, make_submap):
    world = World(tmp_path, make_submap, landmarks=80)
    keep(world, 10**9)
    world.run(5.0)
    world.submap(0)
    world.run(10.0)
    uplink, now = world.uplink, world.now_s
    uplink.details.want([(2, 0, 1)])
    uplink.views.lack([Lack(ViewKey(PICTURE, SESSION, 10**9))], now)
    assert uplink.details.ready(now) == (2, 0)
    room = min(uplink.details.size((2, 0)), 4000) - 100  # 4000: two seconds of the budget
    assert room > uplink.views.size(uplink.views.ready(now))
    uplink._budget.allows(0, now)
    uplink._budget.spend(round(uplink._budget._level) - room)
    assert not {"details", "piece"} & {m.kind for m in uplink.due(now)}
    sent = [m.kind for k in range(1, 10) for m in uplink.due(now + k)]
    assert [kind for kind in sent if kind in ("details", "piece")][:2] == ["details", "piece"]
