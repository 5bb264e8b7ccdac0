# SPDX-License-Identifier: Apache-2.0
"""What a node does with odd stamps, with faults of its callbacks, and with jumps of its inputs' clock."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS")
pytestmark = pytest.mark.ros

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from slam_core import ros  # noqa: E402
from slam_core.config import Config, parameter  # noqa: E402
from slam_core.messages import STATIC_TRANSFORMS_TOPIC, header_message, stamp_ns, transform_message  # noqa: E402
from slam_core.nodes.base_node import SlamNode  # noqa: E402
from slam_core.nodes.exchange import Exchange, Listener  # noqa: E402
from slam_core.nodes.job_queue import QueuedCall  # noqa: E402
from slam_core.ros import sensor_qos  # noqa: E402

START = 1_700_000_000 * 10**9
MS = 10**6


@dataclass(frozen=True)
class EarConfig(Config):
    """Two parameters."""

    patience: int = parameter(3, "may change", minimum=0)
    fixed: int = parameter(1, "may not")


class Sender:
    """Stands for the publisher of diagnostics; notes what they say is not connected."""

    def __init__(self, heard: list[str]) -> None:
        self._heard = heard

    def publish(self, message: Any) -> None:
        values = {v.key: v.value for v in message.status[0].values}
        self._heard.append(values["unconnected"])


class EarNode(SlamNode[EarConfig]):
    """Remembers what it was given and what was made of it."""

    CHANGEABLE = ("patience",)

    def __init__(self) -> None:
        super().__init__("ear", EarConfig)
        self.heard: list[int] = []
        self.sessions = self.resets = 0
        self.listen("frames", "PointCloud2", lambda m: self.heard.append(stamp_ns(m)))
        self.listen("click", "PointStamped", lambda m: self.heard.append(-stamp_ns(m)))
        self.listen("other/frames", "PointCloud2", lambda m: self.heard.append(stamp_ns(m)), clock="other")
        self.create_service(Trigger, "~/break", lambda request, response: 1 / 0)

    def on_new_session(self) -> None:
        self.sessions += 1

    def on_reset(self) -> None:
        self.resets += 1


@pytest.fixture
def node(domain: int) -> Iterator[EarNode]:
    rclpy.init()
    node = EarNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def send(node: EarNode, topic: str, *stamps: int) -> None:
    entry = node._inputs[topic]
    kind = node.types.PointStamped if topic == "click" else node.types.PointCloud2
    for stamp in stamps:
        node._receive(entry, kind(header=header_message(node.types, stamp, "")))
        while node.work():
            pass


def test_odd_stamps_are_rejected_and_only_a_lasting_jump_begins_a_session(node: EarNode) -> None:
    good = [START + k * 100 * MS for k in range(10)]
    hour = 3600 * 10**9
    send(node, "frames", *good[:5], good[4] + hour, good[5], 0, good[6], good[3], *good[7:])
    assert node.heard == good
    assert node.health.counters["rejected"] == 3
    assert (node.sessions, node.resets) == (0, 0)
    again = [stamp - hour for stamp in good]
    send(node, "frames", *again)
    assert node.heard == good + again
    assert (node.sessions, node.resets) == (1, 0)


def test_rigs_whose_clocks_differ_by_hours_are_heard_side_by_side(node: EarNode) -> None:
    sent = []
    for k in range(5):
        for topic, stamp in (("frames", START), ("other/frames", START - 5 * 3600 * 1000 * MS)):
            sent.append(stamp + k * 100 * MS)
            send(node, topic, sent[-1])
    assert node.heard == sent
    assert node.health.counters["rejected"] == node.sessions == 0


def test_messages_without_end_do_not_keep_a_node_from_its_work(node: EarNode) -> None:
    class Flood:
        """An executor for which another message has always come."""

        def spin_once(self, timeout_sec: float) -> None:
            node.calls += 1
            if node.calls > 10_000:
                raise RecursionError

    node.create_client(Trigger, "other")  # so that the executor alone is asked
    ros._serve(node, ros.MessageWait(node), Flood())
    assert node.calls > 10


def test_an_operators_stamp_means_nothing(node: EarNode) -> None:
    send(node, "frames", START, START + 100 * MS)
    send(node, "click", 0, 5 * START, 0, 1, 0, 2, 0)
    send(node, "frames", START + 200 * MS)
    assert len(node.heard) == 10
    assert (node.sessions, node.resets, node.health.counters["rejected"]) == (0, 0, 0)


def test_transforms_are_received_before_the_frames_that_need_them(node: EarNode) -> None:
    profile = sensor_qos(10, latched=True)
    transforms = node.create_publisher(node.types.TransformStamped, STATIC_TRANSFORMS_TOPIC, profile)
    frames = node.create_publisher(node.types.PointCloud2, "frames", sensor_qos(10))
    deadline = time.monotonic() + 20.0
    while {"frames", STATIC_TRANSFORMS_TOPIC} & set(node._unconnected()) and time.monotonic() < deadline:
        time.sleep(0.01)
    known: list[bool] = []
    entry = node._inputs["frames"]
    entry.subscription.callback = lambda message: known.append(len(node.lookup("rig", "lens")) == 4)
    transforms.publish(transform_message(node.types, START, "rig", "lens", np.eye(4)))
    frames.publish(node.types.PointCloud2(header=header_message(node.types, START, "lens")))
    assert transforms.wait_for_all_acked()
    assert frames.wait_for_all_acked()
    node.receive()
    assert known == [True]


def test_a_fault_in_a_service_or_timer_is_answered_and_counted(node: EarNode) -> None:
    node.create_timer(0.01, lambda: [][1])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    client: Any = node.create_client(Trigger, "/ear/break")
    future = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(future, timeout_sec=20.0)
    assert not future.result().success
    assert "ZeroDivisionError" in future.result().message
    while node.health.counters["faults"] < 3:
        executor.spin_once(timeout_sec=1.0)
    executor.shutdown()


def test_a_live_node_leaves_out_what_comes_too_fast_and_says_so(node: EarNode) -> None:
    entry, progress = node._inputs["frames"], []
    node._announce = progress.append  # type: ignore[method-assign]
    for k in range(10):
        node._receive(entry, node.types.PointCloud2(header=header_message(node.types, START + k * 100 * MS, "")))
    while node.work():
        pass
    assert node.heard == [START + 900 * MS]
    assert len(progress) == 10  # a player need not wait for those left out
    status = node._diagnostic_message().status[0]
    assert {v.key: v.value for v in status.values}["skipped"] == "9"
    assert "9 frames left out" in status.message
    assert "left out" not in node._diagnostic_message().status[0].message


class RelayNode(SlamNode[EarConfig]):
    """Hands frames of one topic on to another one."""

    def __init__(self, source: str, sink: str) -> None:
        super().__init__(f"relay_{sink}", EarConfig)
        self.advertise(sink, "PointCloud2")
        self.listen(source, "PointCloud2", lambda m: self.publish(sink, m))


def test_a_frame_that_nobody_can_go_on_with_is_left_out_by_the_first_node(node: EarNode) -> None:
    exchange = Exchange()
    with exchange.node([]):
        first, slow = RelayNode("raw", "half"), RelayNode("half", "done")
    for k in range(10):
        first._receive(
            first._inputs["raw"], node._ros_types.PointCloud2(header=header_message(node.types, START + k * MS, ""))
        )
        while first.work():
            pass
    assert first._jobs.skipped == {"raw": 8}  # one waits at the second node, one at the first
    assert not first.has_work
    slow.receive()
    assert slow.work()
    assert first.has_work
    assert not slow._jobs.skipped
    for relay in (first, slow):
        relay.destroy_node()


def test_a_frame_awakens_a_listener_once_when_all_of_it_is_made(node: EarNode) -> None:
    exchange, seen = Exchange(), []
    with exchange.node([]):
        relay = EarNode()
    listener = Listener(seen.append, lambda: seen.append("awake"), None)
    for topic in ("/depth", "/noise"):
        relay.advertise(topic, "PointCloud2")
        exchange.listen(topic, listener)
    frame = node._ros_types.PointCloud2(header=header_message(node._ros_types, START, ""))
    relay._jobs.add(QueuedCall("frames", lambda: [relay.publish(topic, frame) for topic in ("/depth", "/noise")]))
    relay.work()
    assert seen == [frame, frame, "awake"]
    relay.publish("/depth", frame)
    assert seen[3:] == [frame, "awake"]
    relay.destroy_node()


def test_a_node_reports_at_once_that_its_inputs_are_connected(node: EarNode, monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []
    monkeypatch.setattr(node, "_diagnostics", Sender(reported))
    for unconnected in (["/frames"], ["/frames"], [], []):
        monkeypatch.setattr(node, "_unconnected", lambda topics=unconnected: topics)
        node._report_connections()
    assert reported == ["/frames", ""]
    assert node._connection_timer.is_canceled()
    monkeypatch.setattr(node, "_unconnected", lambda: ["/frames"])
    node._tick()
    assert not node._connection_timer.is_canceled()


def test_what_has_come_belongs_to_an_input_that_ends_and_the_end_is_reported(
    node: EarNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[str] = []
    monkeypatch.setattr(node, "_diagnostics", Sender(reported))
    other = rclpy.create_node("other")
    output = other.create_publisher(node.types.PointCloud2, "frames", sensor_qos(10))
    until = time.monotonic() + 60.0
    while not output.get_subscription_count() and time.monotonic() < until:
        time.sleep(0.02)
    output.publish(node.types.PointCloud2(header=header_message(node.types, START, "")))
    while not node.heard and time.monotonic() < until:  # it is on its way for a moment; nobody spins the node
        time.sleep(0.02)
        with pytest.raises(StopIteration) as end:
            node._on_finish_service(None, Trigger.Response()).send(None)
        assert end.value.value.success
    assert node.heard == [START]
    assert reported
    other.destroy_node()


def test_another_publisher_of_what_a_node_alone_should_say_is_reported(node: EarNode) -> None:
    node.advertise("info", "CameraInfo", alone=True)
    node.advertise("image", "Image")
    assert node._rivals() == ""
    rival = rclpy.create_node("rival")
    rival.create_publisher(node.types.CameraInfo, "info", 1)
    rival.create_publisher(node.types.Image, "image", 1)
    end = time.monotonic() + 60.0
    while not node._rivals() and time.monotonic() < end:
        time.sleep(0.05)
    assert node._rivals() == "info is published by /rival too: remap it there"
    rival.destroy_node()


def test_gaps_of_the_stamps_are_counted(node: EarNode) -> None:
    send(node, "frames", *(START + k * 100 * MS for k in (0, 1, 2, 3, 4, 7, 8)))
    values = {v.key: v.value for v in node._diagnostic_message().status[0].values}
    assert values["missing"] == "2"


def test_a_node_is_managed_and_starts_active(node: EarNode) -> None:
    assert node._state_machine.current_state[1] == "active"
    node.trigger_deactivate()
    send(node, "frames", START)
    assert node.heard == []
    node.trigger_activate()
    send(node, "frames", START)
    assert node.heard == [START]
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert node.resets == 1


def test_parameters_change_at_run_time_where_they_can_and_say_why_where_not(node: EarNode) -> None:
    for value, changed in ((5, True), (-1, False), ("many", False)):
        result = node.set_parameters([Parameter("patience", value=value)])[0]
        assert result.successful == changed
        assert changed or "patience" in result.reason
    assert node.config.patience == 5
    refused = node.set_parameters([Parameter("fixed", value=2)])[0]
    assert not refused.successful
    assert "fixed" in refused.reason
