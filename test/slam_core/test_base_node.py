"""What a node does with stamps that are not in order, without a running graph."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from slam_core.health import Health

base_node = pytest.importorskip("slam_core.base_node", reason="needs ROS")


def message(seconds: float) -> SimpleNamespace:
    nanoseconds = round(seconds * 1e9)
    stamp = SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp))


def test_a_message_out_of_order_is_rejected_and_time_that_begins_anew_resets() -> None:
    handled: list[float] = []
    resets: list[str] = []
    rejected: list[str] = []
    node = SimpleNamespace(_paused=False, health=Health(), reset=resets.append, _reject=rejected.append)
    entry = base_node._Input("/imu", None, lambda stamp, _: handled.append(stamp / 1e9), latched=False, required=True)
    for seconds in (10.0, 10.1, 10.095, 10.1, 10.2, 3.0, 3.1):
        base_node.SlamNode._receive(node, entry, message(seconds))
    assert handled == [10.0, 10.1, 10.1, 10.2, 3.0, 3.1]
    assert rejected == ["/imu: message rejected: 0.005 s older than the one before"]
    assert resets == ["time jumped back by 7.200 s on /imu"]
