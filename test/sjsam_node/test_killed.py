# SPDX-License-Identifier: Apache-2.0
"""The process of ``sjsam`` is killed after it saved its map; another one loads the map and goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judging import join
from submap_world import Agent, circle, ring_world

rclpy = pytest.importorskip("rclpy")
pytestmark = pytest.mark.ros

from std_srvs.srv import Trigger  # noqa: E402

from ros_probe import Probe  # noqa: E402
from sjsam_node.global_map import GlobalMap  # noqa: E402
from slam_core.messages import SUBMAP_TOPICS, submap_messages  # noqa: E402
from slam_core.types import Submap  # noqa: E402

DOMAIN = 97


@contextmanager
def neighbour() -> Iterator[Probe]:
    """A new one for each process: an old one would wait for the killed one's answer."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    probe = Probe(context)
    probe.listen("map/path", probe.types.Path, latched=True)
    yield probe
    probe.executor.shutdown()
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


def start(map_path: Path) -> subprocess.Popen[bytes]:
    command = "import sys; from sjsam_node.node import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", command, "--ros-args", "-p", f"map_path:={map_path}"],
        env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def call(probe: Probe, name: str) -> Any:
    client = probe.node.create_client(Trigger, f"/sjsam/{name}")
    probe.wait(client.service_is_ready, f"no service {name}")
    future = client.call_async(Trigger.Request())
    probe.wait(future.done, f"{name} does not answer")
    return future.result()


def send(probe: Probe, submaps: list[Submap], poses: int) -> None:
    """Send submaps and wait until the map's path has so many poses."""
    for submap in submaps:
        for topic, message in zip(SUBMAP_TOPICS, submap_messages(probe.types, submap), strict=True):
            probe.send(topic, message)
    paths = probe.received["map/path"]
    probe.wait(lambda: any(len(m.poses) == poses for m in paths), f"no path of {poses} poses")


def test_a_killed_node_goes_on_from_its_saved_map(rng: np.random.Generator, tmp_path: Path) -> None:
    agent = Agent(ring_world(3.0, rng, 12.0), circle(3.0, 1.2), rng, "")
    submaps, half = agent.submaps(), 12
    first = start(tmp_path / "map")
    try:
        with neighbour() as probe:
            send(probe, submaps[:half], half * agent.steps + 1)
            assert call(probe, "save_map").success
            assert len(GlobalMap.load(tmp_path / "map.autosave").graph.records) == half  # no less than was saved
            assert call(probe, "mark_here").success  # after saving: must be gone
            first.send_signal(signal.SIGKILL)
    finally:
        first.kill()
        first.wait()
    saved = GlobalMap.load(tmp_path / "map")
    assert not saved.marks.marks
    second = start(tmp_path / "map")
    try:
        with neighbour() as probe:
            assert call(probe, "load_map").success
            send(probe, submaps[half:], len(submaps) * agent.steps + 1)
            assert call(probe, "save_map").success
        second.send_signal(signal.SIGINT)
        assert second.wait(20) == 0
    finally:
        second.kill()
        second.wait()
    continued = GlobalMap.load(tmp_path / "map")
    join(submaps[half:], saved)
    saved.settle()  # as saving does
    assert any(k.is_closure for k in continued.graph.links)
    assert len(continued.graph.links) == len(saved.graph.links)
    assert np.abs(continued.graph.poses - saved.graph.poses).max() < 1e-9
