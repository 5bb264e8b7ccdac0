# SPDX-License-Identifier: Apache-2.0
"""Nodes of a test as processes of their own, and a port for what they open."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy

from ros_probe import Probe
from slam_bringup.processes.node_arguments import ros_arguments
from slam_bringup.processes.processes import PrivateDomain, find_executable, node_environment


def free_port() -> int:
    """A port of this machine that nobody listens at; another process may be sooner to take it."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def begin_node(
    environment: Mapping[str, str], package: str, executable: str, log: Path, namespace: str = "", **parameters: Any
) -> subprocess.Popen[bytes]:
    """Start a node that appends what it says to ``log``."""
    command = [*find_executable(package, executable, []), *ros_arguments(parameters, namespace)]
    with log.open("ab") as output:
        return subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)


def end_node(process: subprocess.Popen[bytes], log: Path) -> None:
    """End a node by Ctrl-C, which has to work; one that does not end is killed: it would be in others' way."""
    process.send_signal(signal.SIGINT)
    try:
        code = process.wait(60)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        pytest.fail(f"{process.args} does not end: {log.read_text(errors='replace')}")
    assert code == 0, log.read_text(errors="replace")


@contextmanager
def private_probe(folder: Path) -> Iterator[tuple[dict[str, str], Probe]]:
    """Environment of nodes that no other test hears, whose state lies below a folder, and a probe among them."""
    with PrivateDomain() as domain, pytest.MonkeyPatch.context() as patch:
        environment = node_environment(domain) | {"XDG_STATE_HOME": str(folder / "state")}
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
            patch.setitem(os.environ, name, environment[name])
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        probe = Probe(context)
        try:
            yield environment, probe
        finally:
            probe.executor.shutdown()
            probe.node.destroy_node()
            context.try_shutdown()


@contextmanager
def node(
    environment: Mapping[str, str], package: str, executable: str, log: Path, namespace: str = "", **parameters: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A node that runs meanwhile; the test may have ended it before."""
    process = begin_node(environment, package, executable, log, namespace, **parameters)
    try:
        yield process
    finally:
        if process.poll() is None:
            end_node(process, log)
