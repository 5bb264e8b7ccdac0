# SPDX-License-Identifier: Apache-2.0
"""An agent among others, on a made-up node: who is served when, and what is kept for whom."""

from __future__ import annotations

from collections import Counter

import pytest
from radio_world import STEP_S

from slam_bags.storage.bag_types import BagTypes
from slam_core.health import Health, State
from slam_core.messages import submap_messages
from slam_radio.packing.light_submap import LightConfig
from slam_radio.peer_end import PeerEnd
from slam_radio.radio_config import RadioConfig
from slam_radio.wire.link_report import Backlog, pack_backlog
from slam_radio.wire.radio_messages import pack_acknowledgement


class Node:
    """A node without ROS: what it sends and publishes is listed."""

    def __init__(self, folder, agents=("anna", "bert", "cleo"), bytes_per_second=2000.0):
        light = LightConfig(landmarks=5, rank=1)
        self.config = RadioConfig(role="peer", agents=agents, bytes_per_second=bytes_per_second, light=light)
        self.state_folder, self.health, self.types, self.link = folder, Health(), BagTypes(), self
        self.sent, self.published = [], Counter()

    def listen(self, *args, **more):
        pass

    listen_together = advertise = broadcast = serve = listen

    def publish(self, topic, message):
        self.published[topic] += 1

    def send(self, key, data, *, urgent):
        self.sent.append(key)

    def get_logger(self):
        return self

    def info(self, text):
        pass


def full_disk(*_):
    raise OSError("no space left on device")


@pytest.fixture
def now(monkeypatch):
    """Seconds of the steady clock, to be set."""
    clock = [100.0]
    monkeypatch.setattr("slam_radio.peer_end.time.monotonic", lambda: clock[0])
    return clock


class Agent:
    """The end of anna, and the submaps that each of the others has had."""

    def __init__(self, folder, make, now, **more):
        self.node, self.make, self.now = Node(folder, **more), make, now
        self.end = PeerEnd(self.node)
        self.had = {other: [] for other in self.end.uplinks}

    def submap(self, index, landmarks=5):
        submap = self.make(landmarks, seed=index, index=index, agent="")
        self.end.on_own_submap(*submap_messages(self.node.types, submap))

    def run(self, seconds, *, acknowledges=True):
        for _ in range(round(seconds / STEP_S)):
            self.now[0] += STEP_S
            self.node.sent.clear()
            self.end.pump(self.now[0])
            for key in self.node.sent:
                other, kind, *rest = key.split("/")[3:]
                if kind == "submap":
                    self.had[other].append(int(rest[1]))
            for other, had in self.had.items():
                ranges = [(2, index, index + 1) for index in had] if acknowledges else []
                self.end.on_acknowledgement(other, "", pack_acknowledgement(ranges[-20:]))


def test_at_overload_all_others_get_as_much(tmp_path, make_submap, now):
    agent = Agent(tmp_path, make_submap, now, agents=("anna", "bert", "cleo", "dora"))
    agent.run(1.0)
    for index in range(100):
        agent.submap(index)
        agent.run(0.2)
    counts = [len(had) for had in agent.had.values()]
    assert 10 < min(counts) <= max(counts) <= min(counts) + 1
    assert max(counts) < 99


def test_own_submaps_that_are_too_many_for_the_links_are_said(tmp_path, make_submap, now):
    agent = Agent(tmp_path, make_submap, now)
    agent.run(1.0)
    for other in agent.had:
        agent.end.on_backlog(other, "", pack_backlog(Backlog(0, 0, 0.0, 0.0, 0.0, False)))
    agent.submap(0)
    agent.run(5.0)
    assert agent.end.state(now[0]).state is State.OK
    for index in range(1, 150):
        agent.submap(index)
        agent.run(0.3)
        for other in agent.had:
            agent.end.on_backlog(other, "", pack_backlog(Backlog(0, 0, 0.0, 0.0, 0.0, False)))
    state = agent.end.state(now[0])
    assert state.state is State.DEGRADED
    assert "more comes in for bert" in state.reason
    assert "more comes in for cleo" in state.reason


def test_a_submap_that_only_some_outboxes_took_is_kept_for_the_others_when_it_comes_again(
    tmp_path, make_submap, now, monkeypatch
):
    agent = Agent(tmp_path, make_submap, now)
    with monkeypatch.context() as patch:
        patch.setattr(agent.end.uplinks["cleo"].outbox, "add", full_disk)
        with pytest.raises(ValueError, match="cannot be kept for the others"):
            agent.submap(0)
    agent.submap(0)
    agent.submap(0)
    assert agent.node.health.counters["submaps sent again"] == 1
    assert agent.node.published["anna/submap/info"] == 1
    agent.run(5.0)
    assert agent.had == {"bert": [0], "cleo": [0]}


def test_who_joins_later_gets_what_was_there_before(tmp_path, make_submap, now):
    before = Agent(tmp_path, make_submap, now)
    for index in range(3):
        before.submap(index)
    before.run(20.0)
    before.end.close()
    after = Agent(tmp_path, make_submap, now, agents=("anna", "bert", "cleo", "dora"))
    after.run(20.0)
    assert after.had == {"bert": [], "cleo": [], "dora": [0, 1, 2]}


def test_what_no_other_could_unpack_is_kept_for_none(tmp_path, make_submap, now, monkeypatch):
    agent = Agent(tmp_path, make_submap, now)
    monkeypatch.setattr("slam_radio.peer_end.pack", lambda *_: b"nonsense")
    with pytest.raises(ValueError, match="submap for the air"):
        agent.submap(0)
    assert not any(uplink.outbox.waiting for uplink in agent.end.uplinks.values())
