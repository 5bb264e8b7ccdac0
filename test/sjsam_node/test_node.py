# SPDX-License-Identifier: Apache-2.0
"""The node as its neighbours see it: submaps over topics in, map, path, transform and services out."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

rclpy = pytest.importorskip("rclpy")
pytestmark = pytest.mark.ros


from node_bench import Bench, running  # noqa: E402

from sjsam_node.agents import in_order  # noqa: E402
from sjsam_node.global_map import GlobalMap, JoinReport  # noqa: E402
from sjsam_node.session.map_session import MapSession  # noqa: E402
from slam_core.geometry import boxminus, make_transform, rotation_from_euler, transform_from_pose7  # noqa: E402
from slam_core.messages import SUBMAP_TOPICS, odometry_message, path_from_message, submap_messages  # noqa: E402
from slam_core.types import PoseEstimate, PositionReading, Submap  # noqa: E402


@pytest.fixture(params=["agents:=['']"])
def bench(request: pytest.FixtureRequest, tmp_path: Path, domain: int) -> Any:
    with running(f"map_path:={tmp_path / 'map'}", f"ply_path:={tmp_path / 'map.ply'}", request.param) as bench:
        yield bench


def test_submaps_in_map_out_and_services(bench: Bench, rng: np.random.Generator, tmp_path: Path) -> None:
    agent = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.5), rng, "")
    submaps = agent.submaps()
    for topic, kind in (
        ("map/path", "Path"),
        ("map_to_odom", "TransformStamped"),
        ("pose", "PoseWithCovarianceStamped"),
        ("map/landmarks", "PointCloud2"),
        ("map/graph", "MarkerArray"),
        ("map/marks", "MarkerArray"),
    ):
        bench.listen(topic, kind)
    bench.send(submaps)
    assert bench.spin_until(lambda: len(bench.node.map.snapshot) == len(submaps))
    wanted = len(submaps) * agent.steps + 1
    assert bench.spin_until(lambda: any(len(m.poses) == wanted for m in bench.received["map/path"]))
    offline, _ = join(submaps)
    online = path_from_message(bench.received["map/path"][-1])
    for (stamp, T), pose in zip(online, offline.trajectory(""), strict=True):
        assert stamp == pose.stamp_ns
        assert np.abs(boxminus(T, pose.T)).max() < 1e-9
    published = len(bench.received["map/path"])
    assert not bench.spin_until(lambda: len(bench.received["map/path"]) > published, 1.5), "published without news"
    transform = bench.received["map_to_odom"][-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")

    assert bench.call("save_map").success
    assert (tmp_path / "map" / "manifest.json").exists()
    assert bench.call("export_ply").success
    assert (tmp_path / "map.ply").stat().st_size > 100
    assert bench.call("mark_here").success
    click = bench.publisher("clicked_point", "PointStamped")
    click.publish(bench.types.PointStamped(header=bench.types.Header(frame_id="map"), point=bench.types.Point(x=1.0)))
    assert bench.spin_until(lambda: len(bench.node.map.snapshot.marks.marks) == 2, 5.0)
    assert bench.call("reset").success
    assert len(bench.node.map.snapshot) == 0
    assert bench.call("load_map").success
    assert len(bench.node.map.snapshot) == len(submaps)


def test_map_to_odom_leads_from_odometry_to_where_the_rig_is_in_the_map(bench: Bench, submaps: list[Submap]) -> None:
    """The odometry's origin is turned by a quarter and 5 m away: an inverse or an identity would be far off."""
    T_odom_map = make_transform(rotation_from_euler(np.pi / 2), np.array([5.0, -3.0, 0.5]))
    offline, _ = join(submaps)
    bench.listen("map_to_odom", "TransformStamped")
    bench.listen("pose", "PoseWithCovarianceStamped")
    publisher = bench.publisher("odom", "Odometry")
    for pose in offline.trajectory(""):
        in_odom = PoseEstimate(pose.stamp_ns, T_odom_map @ pose.T, 1e-6 * np.eye(6))
        publisher.publish(odometry_message(bench.types, "odom", "base_link", in_odom))
        bench.spin_until(lambda: False, 0.01)
    bench.send(submaps)
    assert bench.spin_until(lambda: bench.counters["submaps joined"] == len(submaps))
    heard = len(bench.received["map_to_odom"])
    assert bench.spin_until(lambda: len(bench.received["map_to_odom"]) > heard + 2)
    sent = bench.received["map_to_odom"][-1]
    t, q = sent.transform.translation, sent.transform.rotation
    T_map_odom = transform_from_pose7(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]))
    end = offline.end_pose("").T
    assert np.abs(boxminus(T_map_odom @ T_odom_map @ end, end)).max() < 0.05


def test_a_submap_that_did_not_arrive_is_asked_for_again_and_then_told(bench: Bench, rng: np.random.Generator) -> None:
    submaps = Agent(ring_world(4.0, rng, 12.0), circle(4.0, 0.5), rng, "").submaps()[:8]
    publishers = [bench.publisher(topic, kind) for topic, kind in SUBMAP_TOPICS.items()]

    def send(*indices: int) -> None:
        for index in indices:
            for publisher, message in zip(publishers, submap_messages(bench.types, submaps[index]), strict=True):
                publisher.publish(message)

    def joined() -> list[int]:
        return [submap.index for submap in bench.node.map.snapshot.submaps]

    counters = bench.node.health.counters
    send(0, 1, 3, 4)
    assert bench.spin_until(lambda: counters.get("submaps sent again", 0) >= 2)  # all are asked for again
    assert joined() == [0, 1]
    send(2)
    assert bench.spin_until(lambda: len(joined()) == 5)
    assert joined() == [0, 1, 2, 3, 4]
    assert bench.node.map.snapshot.components == 1
    send(6)
    assert bench.spin_until(lambda: counters.get("submaps missed", 0) == 1)
    assert bench.spin_until(lambda: joined() == [0, 1, 2, 3, 4, 6])


@pytest.mark.parametrize("bench", ["agents:=['a','b']"], indirect=True)
def test_the_finished_map_of_two_agents_is_that_of_a_session_offline_to_the_byte(
    bench: Bench, rng: np.random.Generator, tmp_path: Path
) -> None:
    world, path = ring_world(4.0, rng, 12.0), circle(4.0, 1.0)
    A = Agent(world, path[:61], rng, "a").submaps()
    B = Agent(world, path[45:], rng, "b", stamp_ns=2_000_000_000).submaps()
    bench.send(B + A)
    assert bench.spin_until(lambda: bench.counters["submaps received"] == len(A + B))
    assert bench.call("finish").success
    assert bench.call("save_map").success
    with MapSession(bench.node.config) as session:
        for submap in in_order(A + B):
            session.add(submap)
        session.finish().result()
        session.save(tmp_path / "offline").result()
    online, offline = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in ("map", "offline"))
    assert online == offline


@pytest.mark.parametrize("bench", ["agents:=['a','b']"], indirect=True)
def test_parts_of_the_map_are_named_by_their_agents(bench: Bench, rng: np.random.Generator) -> None:
    path = circle(4.0, 0.2)
    A, B = (Agent(ring_world(4.0, rng, 12.0), path, rng, name).submaps() for name in "ab")
    bench.send(A + B)
    assert bench.spin_until(lambda: bench.counters["submaps joined"] == len(A + B))
    assert bench.spin_until(lambda: bench.node.health.reason == "2 separate parts: a; b", 5.0)


def test_services_answer_on_an_empty_map(bench: Bench) -> None:
    assert not bench.call("load_map").success
    assert not bench.call("mark_here").success


class SlowJoiner:
    """``GlobalMap.add`` that joins nothing more until it may go on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, before: int) -> None:
        self.may_go_on, self.is_held = threading.Event(), threading.Event()
        add, left = GlobalMap.add, iter(range(before))

        def slow_add(joined: GlobalMap, submap: Submap, readings: Sequence[PositionReading]) -> JoinReport:
            if next(left, None) is None:
                self.is_held.set()
                assert self.may_go_on.wait(60.0)
            return add(joined, submap, readings)

        monkeypatch.setattr(GlobalMap, "add", slow_add)


@pytest.fixture
def submaps(rng: np.random.Generator) -> list[Submap]:
    return Agent(ring_world(3.0, rng, 12.0), circle(3.0, 0.4), rng, "").submaps()


def test_everything_is_answered_while_a_submap_is_being_joined(
    bench: Bench, submaps: list[Submap], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    slow = SlowJoiner(monkeypatch, before=2)
    bench.listen("map_to_odom", "TransformStamped")
    bench.listen("map/marks", "MarkerArray")
    bench.send(submaps)
    assert bench.spin_until(lambda: bench.counters["submaps received"] == len(submaps) and slow.is_held.is_set())
    heard = len(bench.received["map_to_odom"])
    assert bench.spin_until(lambda: len(bench.received["map_to_odom"]) > heard + 3)
    assert bench.call("mark_here").message == "mark 1"
    assert bench.spin_until(lambda: len(bench.received["map/marks"]) > 0)
    saved, finished = bench.ask("save_map"), bench.ask("finish")
    assert not bench.spin_until(lambda: saved.done() or finished.done(), 0.5)
    counters = bench.counters
    assert (counters["submaps joined"], counters["submaps waiting"]) == (2, len(submaps) - 2)
    slow.may_go_on.set()
    assert bench.spin_until(lambda: saved.done() and finished.done())
    assert f"{len(submaps)} submaps joined" in finished.result().message
    assert len(GlobalMap.load(tmp_path / "map").estimate.graph.records) == 3, "the map is saved as soon as it can be"
    counters = bench.counters
    assert (counters["submaps joined"], counters["submaps waiting"]) == (len(submaps), 0)


def test_reset_leaves_out_what_waits_and_what_is_being_joined(
    bench: Bench, submaps: list[Submap], monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = SlowJoiner(monkeypatch, before=2)
    bench.send(submaps[:-1])
    assert bench.spin_until(lambda: bench.counters["submaps received"] == len(submaps) - 1 and slow.is_held.is_set())
    assert bench.spin_until(lambda: bench.counters["submaps joined"] == 2)
    assert bench.call("reset").success
    bench.send(submaps[-1:])
    assert bench.spin_until(lambda: bench.counters["submaps received"] == len(submaps))
    slow.may_go_on.set()
    assert bench.call("finish").success
    assert [submap.index for submap in bench.node.map.snapshot.submaps] == [submaps[-1].index]
    assert bench.counters["submaps joined"] == 3


def test_what_waits_when_the_node_is_told_to_end_is_in_the_copy(
    bench: Bench, submaps: list[Submap], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    slow = SlowJoiner(monkeypatch, before=1)
    bench.send(submaps)
    assert bench.spin_until(lambda: bench.counters["submaps received"] == len(submaps) and slow.is_held.is_set())
    slow.may_go_on.set()
    bench.node.on_close()
    assert len(GlobalMap.load(tmp_path / "map.autosave.ended").estimate.graph.records) == len(submaps)
