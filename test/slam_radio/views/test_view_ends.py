# SPDX-License-Identifier: Apache-2.0
"""Both ends of views on a made-up node: which images are taken, where they are kept, and who is asked."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_core.camera import Camera
from slam_core.health import Health
from slam_core.messages import depth_messages, header_message, image_message, path_message, submap_messages
from slam_core.types import DepthImage
from slam_radio.link_end import End
from slam_radio.link_ends import AgentEnd
from slam_radio.packing.light_submap import LightConfig
from slam_radio.radio_config import RadioConfig
from slam_radio.view_ends import AgentViews, PostViews
from slam_radio.views.view_config import ViewConfig
from slam_radio.views.view_format import DENSE, PICTURE, PlacedImage, pack_view
from slam_radio.views.view_taker import encoded
from slam_radio.wire.view_messages import ViewKey, pack_piece, pieces_of

AGENT = "anna"


class Node:
    """A node without ROS: what it publishes is counted, what it says is listed."""

    def __init__(self, folder, **views):
        light = LightConfig(landmarks=5, rank=1)
        self.config = RadioConfig(agents=(AGENT,), light=light, views=ViewConfig(**views))
        self.state_folder, self.health, self.types, self.link = folder, Health(), BagTypes(), self
        self.heard, self.published, self.said, self.frames = [], Counter(), [], {"left": np.eye(4)}

    def listen(self, topic, *args, **more):
        self.heard.append(topic)

    listen_together = advertise = serve = listen

    def lookup(self, target, source):
        if source not in self.frames:
            raise ValueError(f"no transform from {source} to {target}")
        return self.frames[source]

    def publish(self, topic, message):
        self.published[topic] += 1

    def get_logger(self):
        return self

    def info(self, text, **more):
        self.said.append(text)

    warning = info


@pytest.fixture
def node(tmp_path):
    return Node(tmp_path)


def picture(stamp_ns, session=2):
    pixels = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    return PlacedImage(session, 0, stamp_ns, 0, np.eye(4), (64, 64), (0.0, 0.0, 0.0, 0.0), encoded(pixels, 80))


def image(node, stamp_ns, frame="left"):
    pixels = np.full((60, 80, 3), 90, dtype=np.uint8)
    return image_message(node.types, header_message(node.types, stamp_ns, frame), pixels, "rgb8")


def depth(node, frame):
    values = np.full((60, 80), 2.0, dtype=np.float32)
    camera = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)
    found = DepthImage(10**9, values, np.full_like(values, 0.01), camera, frame_id=frame)
    return depth_messages(node.types, found)[:3]


def test_an_agent_and_a_post_of_one_state_folder_do_not_meet(node):
    agent = AgentViews(End(node), AGENT)
    post = PostViews(End(node), [AGENT])
    assert agent.files.path != post.inboxes[AGENT].files.path
    post.close()
    agent.close()


def test_a_view_that_the_start_finds_whole_is_published_once(node):
    post = PostViews(End(node), [AGENT])
    key = ViewKey(PICTURE, 2, 10**9)
    inbox = post.inboxes[AGENT]
    inbox.ask(key)

    def full_disk(*_):
        raise OSError("no space left on device")

    inbox.files.add = full_disk
    *pieces, last = pieces_of(key, 10**9, pack_view(picture(10**9)))
    for piece in pieces:
        inbox.take(pack_piece(piece))
    with pytest.raises(OSError, match="no space"):
        inbox.take(pack_piece(last))
    post.close()
    post = PostViews(End(node), [AGENT])
    assert not node.published
    for _ in range(2):
        post.show()
    assert node.published == {f"{AGENT}/view/picture/compressed": 1}


def test_a_submap_goes_out_whatever_becomes_of_its_images(node, make_submap):
    end = AgentEnd(node)
    submap = make_submap(5, index=0, agent="")
    end.views.on_pose(np.eye(4))
    end.views.on_picture(1, image(node, submap.start_stamp_ns + 1))
    (end.views.files.path / f"{PICTURE}-{submap.session}-{submap.start_stamp_ns + 1}.view").write_bytes(b"another")
    end.on_submap(*submap_messages(node.types, submap))
    assert list(end.uplink.outbox.waiting) == [(submap.session, 0)]
    assert node.health.report(0.0)["views that cannot be kept"] == "1"
    assert "move it away" in node.said[-1]
    end.close()


def test_an_image_without_a_mounting_does_not_cost_the_next_one(node):
    views = AgentViews(End(node), AGENT)
    views.on_pose(np.eye(4))
    for frame in ("unknown", "left"):
        for take in (
            partial(views.on_picture, 1, image(node, 10**9, frame)),
            partial(views.on_depth, *depth(node, frame)),
        ):
            if frame == "unknown":
                with pytest.raises(ValueError, match="no transform"):
                    take()
            else:
                take()
    assert not views.taker.wants(PICTURE)
    assert not views.taker.wants(DENSE)
    views.close()


@pytest.mark.parametrize("colours", [True, False])
def test_colours_are_heard_only_if_they_are_wanted(tmp_path, colours):
    node = Node(tmp_path, colours=colours)
    AgentViews(End(node), AGENT).close()
    assert ("stereo/left/image_rect_color" in node.heard) == colours
    assert {"stereo/left/image_rect", "tof/color/image"} < {topic for topic in node.heard if isinstance(topic, str)}


def test_grey_pictures_are_taken_while_the_colour_camera_is_silent(node):
    views = AgentViews(End(node), AGENT)
    views.on_pose(np.eye(4))
    taken = []
    views.taker.add_picture = lambda stamp_ns, *_: taken.append(stamp_ns)
    colour, grey, _ = range(3)
    for rank, seconds in ((colour, 1), (grey, 1), (grey, 2), (grey, 3), (grey, 4), (colour, 5), (grey, 5)):
        views.on_picture(rank, image(node, seconds * 10**9))
    assert taken == [1 * 10**9, 4 * 10**9, 5 * 10**9]
    views.close()


def point(node, frame, seconds=0):
    header = header_message(node.types, seconds * 10**9, frame)
    return node.types.PointStamped(header=header, point=node.types.Point(x=0.0, y=0.0, z=0.0))


def test_a_place_of_an_earlier_session_is_asked_of_that_session(node, make_submap):
    """Clocks of both began at 0: submaps overlap, and the stamp of the pose that saw the place tells them apart."""
    post = PostViews(End(node), [AGENT])
    first = make_submap(5, index=0, agent=AGENT)
    later = tuple(replace(pose, stamp_ns=pose.stamp_ns + 10**8) for pose in first.path)
    start, end = first.start_stamp_ns, first.end_stamp_ns
    second = replace(
        first, session=first.session + 1, path=later, start_stamp_ns=start + 10**8, end_stamp_ns=end + 10**8
    )
    for submap in (first, second):
        post.on_submap(AGENT, submap)
    seen = first.path[1]
    post.on_path(AGENT, path_message(node.types, end, "map", [seen]))
    post.on_wanted(PICTURE, point(node, "map"))
    post.on_wanted(DENSE, point(node, AGENT))
    inbox = post.inboxes[AGENT]
    assert inbox.wanted == [
        ViewKey(PICTURE, first.session, seen.stamp_ns),
        ViewKey(DENSE, second.session, second.end_stamp_ns),
    ]
    with pytest.raises(ValueError, match="no submap of anna"):
        post.on_wanted(PICTURE, point(node, AGENT, 1000))
    post.close()
