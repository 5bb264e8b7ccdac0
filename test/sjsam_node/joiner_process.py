# SPDX-License-Identifier: Apache-2.0
"""A process of ``sjsam``, and a neighbour that sends it submaps and calls its services."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from ros_probe import Probe
from slam_core.messages import SUBMAP_TOPICS, submap_messages
from slam_core.types import Submap

rclpy = pytest.importorskip("rclpy")


@contextmanager
def neighbour() -> Iterator[Probe]:
    """A new one for each process: an old one would wait for the killed one's answer."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
    probe = Probe(context)
    probe.listen("map/path", probe.types.Path, latched=True)
    yield probe
    probe.executor.shutdown()
    probe.node.destroy_node()
    rclpy.shutdown(context=context)


def start(*parameters: str, before: str = "", **options: Any) -> subprocess.Popen[str]:
    """A node of its own with parameters ``name:=value``; what it says comes through ``stdout``.

    ``before``: Python code that its process runs first.
    """
    given = [word for parameter in parameters for word in ("-p", parameter)]
    return subprocess.Popen(
        [sys.executable, "-c", f"{before}\nfrom sjsam_node.node import main; main()", "--ros-args", *given],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        **options,
    )


@contextmanager
def running(*parameters: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """The same, killed at the end whatever becomes of it."""
    process = start(*parameters, **options)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def call(probe: Probe, name: str) -> Any:
    return probe.call(f"/sjsam/{name}")


def send(probe: Probe, submaps: list[Submap], poses: int) -> None:
    """Send submaps and wait until the map's path has so many poses."""
    for submap in submaps:
        for topic, message in zip(SUBMAP_TOPICS, submap_messages(probe.types, submap), strict=True):
            probe.send(topic, message)
    paths = probe.received["map/path"]
    probe.wait(lambda: any(len(m.poses) == poses for m in paths), f"no path of {poses} poses")
