# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading

import numpy as np
import pytest

from slam_bags.nodes.pacing import Connections, FlowControl, ReplayClock, RequiredSubscribers, header_stamp_ns
from slam_bags.storage.bag_types import BagTypes, typestore
from slam_core.messages import header_message, image_message

STAMP = 1_403_715_273_262_142_976


@pytest.mark.parametrize("little_endian", [True, False])
def test_header_stamp_is_read_from_the_bytes(little_endian: bool) -> None:
    types = BagTypes()
    message = image_message(types, header_message(types, STAMP, "camera"), np.zeros((2, 2), np.uint8))
    data = typestore().serialize_cdr(message, "sensor_msgs/msg/Image", little_endian=little_endian)
    assert header_stamp_ns(bytes(data)) == STAMP


def test_sending_blocks_at_the_window_and_goes_on_with_progress() -> None:
    flow = FlowControl(["/node=/image"], window=2, patience_s=10.0)
    for stamp in (1, 2):
        assert flow.wait("/image")
        flow.sent("/image", stamp)
    passed = threading.Event()
    thread = threading.Thread(target=lambda: (flow.wait("/image"), passed.set()))
    thread.start()
    assert not passed.wait(0.05)
    flow.progress("/other", 99)
    assert not passed.wait(0.05)
    flow.progress("/node", 1)
    assert passed.wait(5.0)
    thread.join()
    assert flow.gave_up == 0


def test_topics_that_nobody_paces_never_wait() -> None:
    flow = FlowControl(["/node=/image"], window=1, patience_s=10.0)
    for stamp in range(10):
        assert flow.wait("/imu")
        flow.sent("/imu", stamp)
    assert flow.drain()


def test_patience_ends_and_is_counted() -> None:
    flow = FlowControl(["/node=/image"], window=1, patience_s=0.05)
    flow.sent("/image", 1)
    assert not flow.wait("/image")
    assert flow.gave_up == 1
    assert flow.wait("/image")


def test_drain_waits_for_all() -> None:
    flow = FlowControl(["/a=/image", "/b=/image"], window=5, patience_s=10.0)
    flow.sent("/image", 7)
    flow.progress("/a", 7)
    timer = threading.Timer(0.05, flow.progress, ("/b", 7))
    timer.start()
    assert flow.drain()
    timer.join()


@pytest.mark.parametrize("pair", ["/node", "=/topic", "/node="])
def test_a_pair_must_be_one(pair: str) -> None:
    with pytest.raises(ValueError, match="<node>=<topic>"):
        FlowControl([pair], 1, 1.0)


def test_rate_zero_never_delays_and_a_rate_scales_time() -> None:
    assert ReplayClock(0.0).delay_s(10**18) == 0.0
    clock = ReplayClock(2.0)
    assert clock.delay_s(0) == 0.0
    assert 4.0 < clock.delay_s(10 * 10**9) <= 5.0
    with pytest.raises(ValueError, match="-1"):
        ReplayClock(-1.0)


def test_subscribers_are_missing_until_every_topic_has_them() -> None:
    required = RequiredSubscribers(("/left=2", "/tof/info=1", "/imu=0", "/not_played=1"))
    matched = {"/left": 1, "/tof/info": 1, "/imu": 0}
    required.forget_all_but(matched)
    assert required.missing(matched.__getitem__) == ["/left"]
    matched["/left"] = 3
    assert required.missing(matched.__getitem__) == []


@pytest.mark.parametrize("pair", ["/left", "/left=many", "=2", "/left=-1"])
def test_required_subscribers_of_another_form_are_refused(pair: str) -> None:
    with pytest.raises(ValueError, match="topic>=<number"):
        RequiredSubscribers((pair,))


def test_nodes_are_an_obstacle_until_they_report_all_inputs_connected() -> None:
    connections = Connections()
    connections.report("/a", {"unconnected": "/left /tf"})
    assert connections.obstacles(("/a", "/b")) == ["/a has no publisher of /left, /tf", "/b has not reported itself"]
    assert connections.obstacles(("/a",), from_outside=("/left", "/tf")) == []
    connections.report("/a", {"unconnected": ""})
    assert connections.obstacles(("/a",)) == []
