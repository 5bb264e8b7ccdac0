# SPDX-License-Identifier: Apache-2.0
"""What waits at an agent reaches the post in 19 bytes, and the leader's page as values of the diagnostics."""

from __future__ import annotations

import struct

import pytest
from radio_world import World

from slam_core.health import State
from slam_radio.wire.link_report import Backlog, LinkReport, pack_backlog, unpack_backlog

FULL = Backlog(12, 84_000, 42.0, 1500.0, 700.0, is_too_much=True)


@pytest.fixture
def world(tmp_path, make_submap):
    return World(tmp_path, make_submap)


def test_a_backlog_comes_out_as_it_went_in():
    assert len(pack_backlog(FULL)) == 19
    assert unpack_backlog(pack_backlog(FULL)) == FULL
    assert unpack_backlog(pack_backlog(Backlog(10**6, 2**40, 1e30, 0.0, 0.0, is_too_much=False))).submaps == 65535


def test_backlogs_that_cannot_be_are_refused():
    data = pack_backlog(FULL)
    for at, part in {6: struct.pack("<f", float("nan")), 10: struct.pack("<f", -1.0), 18: b"\x02"}.items():
        with pytest.raises(ValueError, match="cannot be"):
            unpack_backlog(data[:at] + part + data[at + len(part) :])
    with pytest.raises(ValueError, match="19 bytes"):
        unpack_backlog(data + b"\0")


@pytest.mark.parametrize("report", [LinkReport(False), LinkReport(True, 1.5), LinkReport(False, 61.0, FULL)])
def test_a_report_comes_out_of_the_diagnostics_as_it_went_in(report):
    values = LinkReport(True, 2.0, Backlog(1, 2, 3.0, 4.0, 5.0, is_too_much=False)).values("anna")
    values |= report.values("anna")  # a node keeps values until they are replaced
    assert LinkReport.of("anna", values) == report
    assert LinkReport.of("bert", values) is None
    with pytest.raises(ValueError, match="cannot have"):
        LinkReport.of("anna", values | {"anna/heard_s_ago": "nan"})


def test_the_post_learns_what_waits_and_that_nothing_does_any_more(world):
    world.run(5.0)
    for index in range(30):
        world.submap(index)
    world.run(6.0)
    first = world.downlink.reports(world.now_s)["one"].backlog
    assert 0 < first.submaps < 30
    assert first.size > 0
    assert first.seconds > 0.0
    world.run(25.0)
    assert not world.uplink.outbox.waiting
    report = world.downlink.reports(world.now_s)["one"]
    assert report.is_up
    assert report.backlog.submaps == 0
    small = [size for _, size in world.sent if size == 19 + 150]
    assert len(small) <= 8, "a backlog is told every few seconds only"


def test_the_post_says_that_a_link_carries_too_little_and_who_is_silent(world):
    world.run(4.0)
    for index in range(300):
        world.submap(index)
        world.run(0.3)
    report = world.downlink.reports(world.now_s)["one"]
    assert report.backlog.is_too_much
    assert report.backlog.came > report.backlog.carried > 0.0
    state = world.downlink.state(world.now_s)
    assert state.state is State.DEGRADED
    assert "more comes in at one" in state.reason
    assert state.backlog_bytes == report.backlog.size
    world.arrives = lambda to_post, now_s: False
    world.run(20.0)
    silent = world.downlink.reports(world.now_s)["one"]
    assert not silent.is_up
    assert 19.0 < silent.heard_s_ago < 21.5
    assert silent.backlog.is_too_much, "what it said last stays"
