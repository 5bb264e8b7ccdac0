# SPDX-License-Identifier: Apache-2.0
"""Both ends of views on a made-up node: which images are taken, where they are kept, and who is asked."""

from __future__ import annotations

from collections import Counter
from functools import partial

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_core.camera import Camera
from slam_core.health import Health
from slam_core.messages import depth_messages, header_message, image_message, submap_messages
from slam_core.types import DepthImage
from slam_radio.link_end import End
from slam_radio.link_ends import AgentEnd
from slam_radio.packing.light_submap import LightConfig
from slam_radio.radio_config import RadioConfig
from slam_radio.view_ends import AgentViews, PostViews
from slam_radio.views.view_config import ViewConfig
from slam_radio.views.view_format import DENSE, PICTURE, View, pack_view
from slam_radio.views.view_taker import encoded
from slam_radio.wire.view_messages import ViewKey, pack_piece, pieces_of

AGENT = "anna"


class Node:
    """A node without ROS: what it publishes is counted, what it says is listed."""

    def __init__(self, folder, **views):
        light = LightConfig(landmarks=5, rank=1)
        self.config = RadioConfig(agents=(AGENT,), light=light, views=ViewConfig(**views))
        self.state_folder, self.health, self.types, self.link = folder, Health(), BagTypes(), self
        self.published, self.said, self.frames = Counter(), [], {"left": np.eye(4)}

    def listen(self, *args, **more):
        pass

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
    return View(session, 0, stamp_ns, 0, np.eye(4), (64, 64), (0.0, 0.0, 0.0, 0.0), encoded(pixels, 80))


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
