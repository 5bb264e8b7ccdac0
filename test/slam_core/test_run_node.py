# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C always ends a node: in order when it can, at once when somebody insists."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("rclpy")
pytestmark = pytest.mark.ros

STUCK = """
import threading
from rclpy.node import Node
from slam_core.ros import run_node
class Stuck(Node):
    def __init__(self): super().__init__("stuck")
    def on_close(self): print("closing", flush=True); threading.Event().wait()
run_node(Stuck)
"""


def test_a_second_wish_ends_a_node_that_never_ends() -> None:
    with subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as node:
        try:
            assert node.stdout is not None
            assert node.stderr is not None
            assert any(b"ready" in line for line in node.stderr)
            node.send_signal(signal.SIGINT)
            node.send_signal(signal.SIGINT)  # as a terminal and ros2 launch together
            assert b"closing" in node.stdout.readline()
            time.sleep(1.1)
            node.send_signal(signal.SIGTERM)  # as ros2 launch after 5 s
            time.sleep(0.3)
            assert node.poll() is None
            node.send_signal(signal.SIGINT)
            assert node.wait(10) == 130
        finally:
            node.kill()
