# SPDX-License-Identifier: Apache-2.0
"""A frame that waits for another sensor goes on without it: by the clock, where the node is live."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS")
pytestmark = pytest.mark.ros

from slam_core.config import Config  # noqa: E402
from slam_core.nodes.input_config import OVERDUE_S  # noqa: E402
from slam_core.nodes.stage_node import StageNode  # noqa: E402


class Stage:
    """Holds frames by their stamps until it gives up the first."""

    def __init__(self) -> None:
        self.waiting = [1, 2]

    @property
    def oldest_waiting_ns(self) -> int | None:
        return self.waiting[0] if self.waiting else None

    def give_up(self) -> None:
        self.waiting.pop(0)


class WaitingNode(StageNode[Config]):
    """Notes when it publishes what need not wait any longer."""

    def __init__(self) -> None:
        super().__init__("waiting", Config)
        self.stage: Any = Stage()
        self.now = 100.0
        self.published: list[float] = []

    def publish_ready(self) -> None:
        self.published.append(self.now)


@pytest.fixture
def node(request: pytest.FixtureRequest, domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[WaitingNode]:
    """A node with the policy that the test names, by default that of live nodes."""
    rclpy.init(args=["--ros-args", "-p", f"input.policy:={getattr(request, 'param', 'newest')}"])
    node = WaitingNode()
    monkeypatch.setattr("slam_core.nodes.stage_node.time.monotonic", lambda: node.now)
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_each_frame_waits_its_own_time_and_no_longer(node: WaitingNode) -> None:
    for _ in range(16):
        node._look_for_overdue()
        while node.work():
            pass
        node.now += 0.25 * OVERDUE_S
    assert node.published == [101.25, 102.75]
    assert node.stage.waiting == []


@pytest.mark.parametrize(("node", "looks"), [("newest", True), ("all", False)], indirect=["node"])
def test_only_a_live_node_looks_at_the_clock(node: WaitingNode, looks: bool) -> None:
    periods_s = [timer.timer_period_ns / 1e9 for timer in node.timers]
    assert (0.25 * OVERDUE_S in periods_s) is looks
