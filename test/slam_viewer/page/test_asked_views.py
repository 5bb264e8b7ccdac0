# SPDX-License-Identifier: Apache-2.0
"""What the page's buttons ask for, and where the pictures that come are shown."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_core.geometry import OPTICAL_FROM_RIG, boxplus, make_transform
from slam_core.messages import compressed_image_message, header_message, pose_stamped_message

pytest.importorskip("rclpy")

from slam_viewer.page.asked_views import AskedViews


class Node:
    """A node without ROS: what it publishes is listed, and its callbacks are known by topic."""

    def __init__(self):
        self.types, self.config = BagTypes(), SimpleNamespace(agents=("anna", "bert"), map_frame="map")
        self.callbacks, self.published = {}, []
        self.advertise = Mock()

    def listen(self, topic, kind, callback, **_):
        self.callbacks[topic] = callback

    def publish(self, topic, message):
        point = message.point
        self.published.append((topic, message.header.frame_id, (point.x, point.y, point.z)))


@pytest.fixture
def page():
    from slam_viewer.page.page import ViewerPage

    page = ViewerPage(0)
    page.show_picture, page.show_camera = Mock(), Mock()
    yield page
    page.stop()


def test_buttons_appear_at_a_post_and_ask(page):
    node = Node()
    views = AskedViews(node, page, lambda origin, direction: None if direction[2] > 0 else origin + direction)
    assert not any(button.visible for button in views._buttons)
    views.offer(is_post=True)
    assert [b.visible for b in views._buttons] == [True] * 4
    views._on_click("wanted_key_frame", np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, -2.0]))
    views._on_click("wanted_picture", np.zeros(3), np.array([0.0, 0.0, 1.0]))  # into the sky
    views.ask("wanted_picture", "bert")
    assert node.published == [
        ("wanted_key_frame", "map", (1.0, 3.0, 1.0)), ("wanted_picture", "bert", (0.0, 0.0, 0.0)),
    ]  # fmt: skip


def test_a_picture_is_shown_where_its_camera_was(page):
    node = Node()
    AskedViews(node, page, lambda *_: None)
    T_map_rig = boxplus(np.eye(4), np.array([1.0, 2.0, 0.5, 0.0, 0.1, 1.0]))
    T_map_camera = make_transform(T_map_rig[:3, :3] @ OPTICAL_FROM_RIG.T, T_map_rig[:3, 3])
    jpeg = cv2.imencode(".jpg", np.full((40, 60, 3), (0, 0, 255), dtype=np.uint8))[1].tobytes()
    for stamp in (5, 6):
        if stamp == 6:
            pose = pose_stamped_message(node.types, stamp, "map", T_map_camera)
            node.callbacks["anna/view/pose"](pose)
        message = compressed_image_message(node.types, header_message(node.types, stamp, "anna"), jpeg, "jpeg")
        node.callbacks["anna/view/picture/compressed"](message)
    assert page.show_picture.call_count == 2
    picture = page.show_picture.call_args.args[0]
    assert picture.shape == (40, 60, 3)
    assert picture[20, 30, 0] > 200 > 50 > picture[20, 30, 2]
    assert page.show_camera.call_count == 1  # of the other picture the map does not say where it was
    np.testing.assert_allclose(page.show_camera.call_args.args[0], T_map_rig, atol=1e-9)
