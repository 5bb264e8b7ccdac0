# SPDX-License-Identifier: Apache-2.0
"""Agents that ask each other for details: what they have then is what a post has, within the budget."""

from __future__ import annotations

from fnmatch import fnmatchcase
from itertools import product

import numpy as np
import pytest
from radio_world import STEP_S

from slam_bags.storage.bag_types import BagTypes
from slam_core.health import Health
from slam_core.messages import SUBMAP_TOPICS, submap_from_messages, submap_messages
from slam_core.messages.submap_keys import submap_keys_message
from slam_core.messages.submaps import SubmapMessages
from slam_radio.packing.light_submap import LightConfig, pack
from slam_radio.packing.submap_details import with_details
from slam_radio.peer_end import PeerEnd
from slam_radio.queues.byte_budget import OVERHEAD, ByteBudget
from slam_radio.queues.detail_sender import DetailSender
from slam_radio.queues.detail_store import DetailStore
from slam_radio.queues.outbox import Outbox
from slam_radio.radio_config import RadioConfig
from slam_radio.uplink import Uplink, UplinkTurns

LIGHT = LightConfig(landmarks=5, rank=1)
LANDMARKS = 12


class Node:
    """A node without ROS, whose link is a made-up channel to the others."""

    def __init__(self, world, folder, agents):
        self.config = RadioConfig(role="peer", agents=agents, bytes_per_second=world.bytes_per_second, light=LIGHT)
        self.state_folder, self.health, self.types, self.link = folder, Health(), BagTypes(), Channel(world, agents[0])
        self.topics, self.services, self.published = {}, {}, {}

    def listen(self, topic, kind, handle, **more):
        self.topics[topic] = handle

    def listen_together(self, *args, **more):
        pass

    advertise = listen_together

    def serve(self, name, action):
        self.services[name] = action

    def publish(self, topic, message):
        self.published.setdefault(topic, []).append(message)

    def do_later(self, _, task):
        task()

    def get_logger(self):
        return self

    def info(self, text, **more):
        pass

    warning = info


class Channel:
    """Messages to all other agents that listen to their keys."""

    def __init__(self, world, name):
        self.world, self.name, self.handlers = world, name, []

    def listen(self, key, handle):
        self.handlers.append((key, handle))

    def send(self, key, data, *, urgent):
        self.world.sent.append((self.world.now[0], self.name, key, len(data) + OVERHEAD))
        for other, node in self.world.nodes.items():
            if other != self.name and self.world.arrives(key):
                for pattern, handle in node.link.handlers:
                    if fnmatchcase(key, pattern):
                        handle(key, data)


class World:
    """Agents among each other, in made-up time."""

    def __init__(self, folder, make, now, names=("anna", "bert"), bytes_per_second=20000.0):
        self.folder, self.make, self.now, self.bytes_per_second = folder, make, now, bytes_per_second
        self.names, self.sent, self.nodes, self.ends = names, [], {}, {}
        self.arrives = lambda key: True
        for name in names:
            self.start(name)

    def start(self, name):
        if name in self.ends:
            self.ends[name].close()
        others = [other for other in self.names if other != name]
        self.nodes[name] = Node(self, self.folder / name, (name, *others))
        self.ends[name] = PeerEnd(self.nodes[name])

    def whole(self, name, index):
        seed = 10 * self.names.index(name) + index
        return self.make(LANDMARKS, seed=seed, index=index, agent=name)

    def submap(self, name, index):
        messages = submap_messages(self.nodes[name].types, self.whole(name, index))
        self.ends[name].on_own_submap(*messages)

    def undecided(self, name, keys):
        """The map of an agent names submaps."""
        self.nodes[name].topics["map/undecided"](submap_keys_message(self.nodes[name].types, 1, keys))

    def run(self, seconds):
        for _ in range(round(seconds / STEP_S)):
            self.now[0] += STEP_S
            for end in self.ends.values():
                end.pump(self.now[0])

    def kinds(self, kind):
        """What went out: sender, receiver and index of each."""
        keys = [key.split("/") for _, _, key, _ in self.sent]
        return [(k[1], k[3], int(k[-1])) for k in keys if k[4] == kind]

    def published(self, name, agent):
        """Submaps of an agent, as another one publishes them."""
        columns = [self.nodes[name].published.get(f"{agent}/{topic}", []) for topic in SUBMAP_TOPICS]
        return [submap_from_messages(SubmapMessages(*messages)) for messages in zip(*columns, strict=True)]


@pytest.fixture
def now(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("slam_radio.peer_end.time.monotonic", lambda: clock[0])
    return clock


@pytest.fixture
def world(tmp_path, make_submap, now):
    world = World(tmp_path, make_submap, now)
    world.run(5.0)
    for name in world.names:
        for index in range(2):
            world.submap(name, index)
    world.run(10.0)
    return world


def as_a_post_has_it(folder, submap):
    """The submap with its details, on all the ways from its agent's filter to the map of a post."""
    submap = submap_from_messages(submap_messages(BagTypes(), submap))
    message, store = pack(submap, LIGHT), DetailStore(folder / f"{submap.agent}-{submap.index}")
    store.keep((2, submap.index), submap, message)
    assert store.pack((2, submap.index))
    found = with_details(message, store.read((2, submap.index)))
    return submap_from_messages(submap_messages(BagTypes(), found))


def same(first, second):
    arrays = ("end_pose", "landmarks", "covariance", "landmark_ids", "sightings", "descriptors")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in arrays)


def test_what_the_map_is_undecided_about_is_asked_for_and_is_then_as_a_post_has_it(world, tmp_path):
    assert world.kinds("details") == []
    world.undecided("bert", [("anna", 2, 1), ("bert", 2, 0), ("dora", 2, 0)])
    world.run(5.0)
    assert world.kinds("details") == [("anna", "bert", 1)]
    for name, index in (("anna", 1), ("bert", 0)):
        found = world.published("bert", name)
        assert [(s.index, len(s.landmarks)) for s in found] == [(0, 5), (1, 5), (index, LANDMARKS)]
        assert same(found[-1], as_a_post_has_it(tmp_path / "post", world.whole(name, index)))
    assert [len(s.landmarks) for name in world.names for s in world.published("anna", name)] == [5] * 4


def test_all_are_asked_for_by_the_service_and_go_out_once_though_both_start_again(world, tmp_path):
    assert world.nodes["anna"].services["~/request_details"]() == "details of 4 submaps asked for"
    world.arrives = lambda key: False
    world.run(3.0)
    for name in world.names:
        world.start(name)
    world.arrives = lambda key: True
    world.run(20.0)
    assert world.kinds("details") == [("bert", "anna", 0), ("bert", "anna", 1)]
    assert world.nodes["anna"].services["~/request_details"]() == "details of 0 submaps asked for"
    assert world.nodes["bert"].services["~/request_details"]() == "details of 4 submaps asked for"
    world.run(20.0)
    for agent, index in product(world.names, range(2)):
        expected = as_a_post_has_it(tmp_path / "post", world.whole(agent, index))
        for name in world.names:
            assert same([s for s in world.published(name, agent) if s.index == index][-1], expected)


def test_what_there_is_not_is_answered_once_and_given_up(world):
    for name in world.names:
        for path in world.ends[name].store.whole.path.iterdir():
            path.unlink()
    world.undecided("anna", [("anna", 2, 0), ("bert", 2, 1)])
    world.run(20.0)
    assert world.kinds("details") == []
    assert [key for _, name, key, _ in world.sent if key.endswith("/none")] == ["slam/bert/to/anna/none"]
    assert world.nodes["anna"].health.counters["details that agents cannot tell"] == 2
    assert world.ends["anna"].own.wanted == set()
    assert world.ends["anna"].downlink.inboxes[0].wanted == set()


def test_own_details_wait_for_a_disk_that_is_full(world, monkeypatch):
    def full_disk(*_):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("slam_radio.queues.inbox.write_ranges", full_disk)
        world.ends["anna"].own.wanted = {(2, 0)}
        world.run(5.0)
    assert world.nodes["anna"].health.counters["not_written"] == 1
    world.run(10.0)
    assert [len(s.landmarks) for s in world.published("anna", "anna")] == [5, 5, LANDMARKS]


def test_details_for_several_take_turns_within_the_budget_and_after_submaps(tmp_path, make_submap, now):
    world = World(tmp_path, make_submap, now, names=("anna", "bert", "cleo"), bytes_per_second=1000.0)
    world.run(5.0)
    for index in range(6):
        world.submap("anna", index)
    world.run(60.0)
    for name in ("bert", "cleo"):
        world.undecided(name, [("anna", 2, index) for index in range(6)])
    world.run(1.0)
    began = world.now[0]
    world.submap("anna", 6)
    world.run(60.0)
    times = {key: at for at, _, key, _ in world.sent if "/anna/to/" in key and at > began}
    details = world.kinds("details")
    receivers = [receiver for _, receiver, _ in details]
    assert sorted(details) == [("anna", name, index) for name in ("bert", "cleo") for index in range(6)]
    assert all(abs(receivers[:k].count("bert") - receivers[:k].count("cleo")) <= 1 for k in range(len(receivers)))
    last = max(times[f"slam/anna/to/{name}/submap/2/6"] for name in ("bert", "cleo"))
    later = [at for key, at in times.items() if "/details/" in key]
    assert later
    assert min(later) >= last
    for first in (began, began + 5.0, began + 10.0):
        spent = sum(size for at, name, _, size in world.sent if name == "anna" and first <= at < first + 10.0)
        assert spent <= 12.0 * 1000.0 + 1500.0


def test_a_submap_that_the_budget_does_not_allow_yet_goes_before_details_for_another(tmp_path, make_submap):
    budget, store, submap = ByteBudget(1000.0), DetailStore(tmp_path / "details"), make_submap(LANDMARKS, index=0)
    store.keep((2, 0), submap, pack(submap, LIGHT))
    bert = Uplink(Outbox(tmp_path / "bert"), budget, details=DetailSender(store))
    cleo = Uplink(Outbox(tmp_path / "cleo"), budget)
    turns = UplinkTurns({"bert": bert, "cleo": cleo})

    def due(now_s):
        sent = [(name, message.kind) for name, message in turns.due(now_s)]
        return [entry for entry in sent if entry[1] != "backlog"]

    bert.on_heard(0.0)
    cleo.on_heard(0.0)
    assert due(0.0) == []
    bert.details.want([(2, 0, 1)])
    cleo.add_submap((2, 0), bytes(1800), 1.0)
    assert budget.allows(2000, 9.0)
    budget.spend(600)
    assert budget.allows(1400, 9.0)
    bert.on_heard(9.0)
    cleo.on_heard(9.0)
    assert due(9.0) == []
    assert due(10.2) == [("cleo", "submap")]
    assert due(11.5) == [("bert", "details")]
