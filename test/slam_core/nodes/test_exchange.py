# SPDX-License-Identifier: Apache-2.0
"""What nodes of one process hand each other refers to the same memory, and becomes an equal message outside."""

from __future__ import annotations

import numpy as np

from slam_bags.storage.bag_types import BagTypes
from slam_core.messages import (
    ellipsoid_markers,
    grey_from_message,
    header_message,
    image_message,
    odometry_message,
    points_from_message,
    points_message,
    stamp_ns,
)
from slam_core.nodes.exchange import Exchange, Listener, SharedTypes, as_ros
from slam_core.types import PoseEstimate

STAMP = 1_700_000_000_123_456_789


def test_an_image_arrives_as_the_memory_that_was_sent(rng) -> None:
    picture = rng.integers(0, 256, (12, 16), dtype=np.uint8)
    shared = SharedTypes(BagTypes())
    message = image_message(shared, header_message(shared, STAMP, "left"), picture)
    received = grey_from_message(message)
    assert np.shares_memory(received, picture)
    np.testing.assert_array_equal(received, picture)
    assert (stamp_ns(message), message.header.frame_id, message.encoding) == (STAMP, "left", "mono8")
    assert not hasattr(message, "format")


def test_a_shared_message_becomes_the_message_that_would_have_been_made(rng) -> None:
    ros = BagTypes()
    shared = SharedTypes(ros)
    points = rng.normal(size=(5, 3)).astype(np.float32)
    estimate = PoseEstimate(STAMP, np.eye(4), np.eye(6))

    def messages(types):
        header = header_message(types, STAMP, "map")
        yield points_message(types, header, points)
        yield odometry_message(types, "odom", "base_link", estimate)
        yield ellipsoid_markers(types, header, points.astype(float), np.tile(np.eye(3), (5, 1, 1)), np.arange(5))

    for expected, got in zip(messages(ros), messages(shared), strict=True):
        assert str(as_ros(got)) == str(expected)
    np.testing.assert_array_equal(points_from_message(next(iter(messages(shared)))), points)


def test_only_listeners_of_a_topic_hear_it() -> None:
    exchange, heard = Exchange(), []
    exchange.advertise("/a", lambda: None)
    assert exchange.has_publisher("/a")
    assert not exchange.has_listeners("/a")
    listener = Listener(heard.append, lambda: heard.append("awake"), None)
    exchange.listen("/a", listener)
    assert exchange.publish("/a", 1) == [listener.awaken]
    assert exchange.publish("/b", 2) == []
    assert heard == [1]


def test_there_is_room_where_any_listener_would_begin_a_frame_at_once() -> None:
    exchange, full, told = Exchange(), {"a": False, "b": False}, []
    exchange.advertise("/depth", lambda: told.append("maker"))
    assert exchange.has_room(["/depth"], ahead=False)
    exchange.listen("/depth", Listener(told.append, lambda: None, None))
    assert exchange.has_room(["/depth"], ahead=False)
    for name in full:
        is_full = lambda ahead, n=name: full[n] and not ahead  # noqa: E731
        exchange.listen("/depth", Listener(told.append, lambda: None, is_full))
    for full["a"], full["b"], room in ((False, True, True), (True, False, True), (True, True, False)):
        assert exchange.has_room(["/depth", "/unheard"], ahead=False) == room
        assert exchange.has_room(["/depth", "/unheard"], ahead=True)
    exchange.tell_of_room("/depth")
    assert told == ["maker"]


def test_a_node_joins_only_while_it_is_made() -> None:
    exchange = Exchange()
    with exchange.node(["--ros-args", "-r", "__ns:=/one"]):
        assert Exchange.current is exchange
        assert exchange.node_options["cli_args"][-1] == "__ns:=/one"
    assert Exchange.current is None
