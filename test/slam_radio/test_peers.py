# SPDX-License-Identifier: Apache-2.0
"""Two agents without a post: each has the map that a post would make of the same bytes, to the byte."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("zenoh")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

sys.path.insert(0, str(Path(__file__).parents[1] / "sjsam_node"))  # submap_world

from submap_world import Agent, circle, ring_world  # noqa: E402

from node_process import begin_node, end_node, free_port, private_probe  # noqa: E402
from ros_probe import Probe  # noqa: E402
from sjsam_node.agents import in_order  # noqa: E402
from sjsam_node.map_file import storage  # noqa: E402
from sjsam_node.node_config import SjsamNodeConfig  # noqa: E402
from sjsam_node.session.map_session import MapSession  # noqa: E402
from slam_bringup.pipeline.configuration import SystemConfig  # noqa: E402
from slam_bringup.processes.node_graph import NodeSpec, peer_nodes  # noqa: E402
from slam_core.messages import SUBMAP_TOPICS, odometry_message, submap_messages  # noqa: E402
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import PoseEstimate, Submap  # noqa: E402
from slam_radio.packing.light_submap import LightConfig, pack, unpack  # noqa: E402
from slam_radio.packing.submap_details import with_details  # noqa: E402
from slam_radio.queues.detail_store import DetailStore  # noqa: E402

LIGHT = LightConfig(landmarks=11)
_PORTS = 5
"""Ports that are tried: one that was free may be taken a moment later."""


class Peers:
    """Nodes of ``slam live --peer`` without those of the cameras, and what they say of themselves."""

    def __init__(self, probe: Probe, environment: dict[str, str], folder: Path, stack: ExitStack) -> None:
        self.probe, self.environment, self.folder, self.stack = probe, environment, folder, stack
        probe.listen("/diagnostics", probe.types.DiagnosticArray)
        self.senders: dict[str, Any] = {}

    def start(self, specs: list[NodeSpec]) -> None:
        for spec in specs:
            self.stack.callback(self._end, self._begun(spec))

    def start_link_at_a_free_port(
        self, specs_at: Callable[[str], dict[str, list[NodeSpec]]]
    ) -> dict[str, list[NodeSpec]]:
        """Specs by agent, without the first one's radio_link, which runs: another process may be sooner at a port."""
        for _ in range(_PORTS):
            specs = specs_at(f"tcp/127.0.0.1:{free_port()}")
            nodes = next(iter(specs.values()))
            link = next(spec for spec in nodes if spec.executable == "radio_link")
            process = self._begun(link)
            try:
                name = f"/{link.namespace}/radio_link"
                self.probe.wait(lambda p=process, n=name: p.poll() is not None or self.says(n), f"{name} says nothing")
            except BaseException:
                process.kill()
                raise
            if process.poll() is None:
                self.stack.callback(self._end, process)
                nodes.remove(link)
                return specs
        pytest.fail(f"no radio_link opens at any of {_PORTS} ports: {self.log()}")

    def map_of(self, spec: NodeSpec) -> Path:
        return self.folder / spec.namespace.replace("/", "_") / "map"

    def _begun(self, spec: NodeSpec) -> subprocess.Popen[bytes]:
        parameters = spec.parameters | ({"map_path": str(self.map_of(spec))} if spec.executable == "sjsam" else {})
        return begin_node(
            self.environment, spec.package, spec.executable, self.folder / "nodes.log", spec.namespace, **parameters
        )

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        end_node(process, self.folder / "nodes.log")

    def log(self) -> str:
        return (self.folder / "nodes.log").read_text(errors="replace")

    def publish(self, submaps: list[Submap], name: str) -> None:
        """Submaps as ``ekf_slam`` publishes them, in the agent's own namespace."""
        types = self.probe.types
        for topic, kind in SUBMAP_TOPICS.items():
            self.senders[f"/{name}/{topic}"] = self.probe.node.create_publisher(
                getattr(types, kind), f"/{name}/{topic}", sensor_qos(200, True)
            )
        for submap in submaps:
            for topic, message in zip(SUBMAP_TOPICS, submap_messages(types, submap), strict=True):
                self.senders[f"/{name}/{topic}"].publish(message)

    def finish_and_save(self, name: str) -> None:
        for service in ("finish", "save_map"):
            assert self.probe.call(f"/{name}/peers/sjsam/{service}").success

    def says(self, node: str) -> bool:
        """True if a node has told of itself."""
        return any(status.name == node for m in self.probe.received["/diagnostics"] for status in m.status)

    def has(self, node: str, count: int, what: str = "submaps received") -> bool:
        """True if the newest diagnostics of a sjsam count so many submaps."""
        for message in reversed(self.probe.received["/diagnostics"]):
            for status in message.status:
                if status.name == node:
                    values = {pair.key: pair.value for pair in status.values}
                    return int(values.get(what, 0)) == count
        return False


@pytest.fixture
def peers(tmp_path: Path) -> Iterator[Peers]:
    with private_probe(tmp_path) as (environment, probe), ExitStack() as stack:
        yield Peers(probe, environment, tmp_path, stack)


def test_two_agents_that_meet_have_the_map_that_a_post_would_have(
    peers: Peers, rng: np.random.Generator, tmp_path: Path
) -> None:
    world, path = ring_world(4.0, rng, 12.0), circle(4.0, 1.0)
    own = {
        "anna": Agent(world, path[:61], rng, "anna").submaps(),
        "bert": Agent(world, path[45:], rng, "bert", stamp_ns=2_000_000_000).submaps(),
    }

    def specs_at(address: str) -> dict[str, list[NodeSpec]]:
        specs = {
            "anna": peer_nodes("anna", {"bert": ""}, (address,), SystemConfig()),
            "bert": peer_nodes("bert", {"anna": address}, (), SystemConfig()),
        }
        specs["anna"][0].parameters.pop("scouting")  # nobody else's agents are to be found by a test
        for nodes in specs.values():
            nodes[0].parameters["light.landmarks"] = LIGHT.landmarks
        return specs

    specs, count = peers.start_link_at_a_free_port(specs_at), sum(map(len, own.values()))
    peers.start(specs["anna"])
    peers.publish(own["anna"], "anna")
    peers.probe.wait(lambda: peers.has("/anna/peers/sjsam", len(own["anna"])), "anna alone has no map of her own")
    peers.start(specs["bert"])
    peers.publish(own["bert"], "bert")
    for name in own:
        peers.probe.wait(lambda n=name: peers.has(f"/{n}/peers/sjsam", count), f"{name} lacks submaps: {peers.log()}")
    peers.probe.listen("/bert/peers/anna/odom", peers.probe.types.Odometry)

    def pose_has_come() -> bool:
        pose = PoseEstimate(10**9, np.eye(4), 1e-4 * np.eye(6))
        peers.probe.send("/anna/odom", odometry_message(peers.probe.types, "odom", "base_link", pose))
        return bool(peers.probe.received["/bert/peers/anna/odom"])

    peers.probe.wait(pose_has_come, f"bert does not hear where anna is: {peers.log()}")
    for name in own:
        peers.finish_and_save(name)
    maps = [peers.map_of(nodes[-1]) for nodes in specs.values()]
    post_map(own, tmp_path / "post", light_as_sent)
    graph = storage.read(tmp_path / "post").state.graph
    ends = [(graph.records[k.first].key[0], graph.records[k.second].key[0]) for k in graph.links if k.is_closure]
    assert any(first != second for first, second in ends), "the agents have not met"
    of_post, of_anna, of_bert = map(contents, (tmp_path / "post", *maps))
    assert of_anna == of_bert
    assert of_anna == of_post

    for name in own:
        assert peers.probe.call(f"/{name}/peers/radio_link/request_details").success
    left_out = sum(len(s.landmarks) > LIGHT.landmarks for submaps in own.values() for s in submaps)
    for name in own:
        have = partial(peers.has, f"/{name}/peers/sjsam", left_out, "submaps refined")
        peers.probe.wait(have, f"{name} lacks details: {peers.log()}")
        peers.finish_and_save(name)
    post_map(own, tmp_path / "post_with_details", partial(detailed_as_sent, tmp_path / "details"))
    detailed, of_anna, of_bert = map(contents, (tmp_path / "post_with_details", *maps))
    assert detailed != of_post
    assert of_anna == of_bert
    assert of_anna == detailed
    assert "Traceback" not in peers.log()


def post_map(own: dict[str, list[Submap]], folder: Path, sent: Callable[[Submap], Submap]) -> None:
    """The map that a post makes of what is sent."""
    with MapSession(SjsamNodeConfig(agents=tuple(own), map_frame="peers_map")) as post:
        for submap in in_order([sent(s) for submaps in own.values() for s in submaps]):
            post.add(submap)
        post.finish().result()
        post.save(folder).result()


def light_as_sent(submap: Submap) -> Submap:
    return unpack(pack(submap, LIGHT))


def detailed_as_sent(folder: Path, submap: Submap) -> Submap:
    """The submap as it is when its details have come."""
    key, store = (submap.session, submap.index), DetailStore(folder / f"{submap.agent}-{submap.index}")
    store.keep(key, submap, pack(submap, LIGHT))
    details = store.read(key) if store.pack(key) else None
    return light_as_sent(submap) if details is None else with_details(pack(submap, LIGHT), details)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}
