# SPDX-License-Identifier: Apache-2.0
"""Real nodes: a post asks for pictures and depth; the pictures are published, the depth is in the dense model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("zenoh")
pytestmark = pytest.mark.ros

from node_process import free_port, node, private_probe  # noqa: E402
from slam_core.camera import Camera  # noqa: E402
from slam_core.geometry import OPTICAL_FROM_RIG, boxplus, make_transform  # noqa: E402
from slam_core.messages import (  # noqa: E402
    STATIC_TRANSFORMS_TOPIC,
    SUBMAP_TOPICS,
    cloud_from_message,
    colour_from_message,
    depth_messages,
    header_message,
    image_message,
    odometry_message,
    path_message,
    pose_from_message,
    stamp_ns,
    submap_messages,
    transform_message,
)
from slam_core.ros import sensor_qos  # noqa: E402
from slam_core.types import DepthImage, PoseEstimate  # noqa: E402

T_BASE_CAMERA = make_transform(OPTICAL_FROM_RIG.T, np.array([0.1, 0.0, 0.2]))
T_MAP_START = boxplus(np.eye(4), np.array([5.0, 1.0, 0.0, 0.0, 0.0, 0.5]))
CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)
WALL_M = 2.0


def test_what_the_post_asks_for_comes(make_submap: Callable[..., Any], tmp_path: Path) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    log = tmp_path / "nodes.log"
    with private_probe(tmp_path) as (environment, probe):
        types = probe.types
        submap = make_submap(10, index=0, agent="")
        stamp = submap.start_stamp_ns + 10**9  # that of the path's middle pose
        senders = {
            topic: probe.node.create_publisher(getattr(types, kind), f"/helmet/{topic}", sensor_qos(100, True))
            for topic, kind in SUBMAP_TOPICS.items()
        }
        mounting = probe.node.create_publisher(types.TransformStamped, STATIC_TRANSFORMS_TOPIC, sensor_qos(10, True))
        for frame in ("left_optical", "tof_optical"):
            mounting.publish(transform_message(types, 0, "base_link", frame, T_BASE_CAMERA))
        probe.listen("/anna/view/picture/compressed", types.CompressedImage, latched=True)
        probe.listen("/anna/view/pose", types.PoseStamped, latched=True)
        probe.listen("/anna/odom", types.Odometry)
        probe.listen("/map/dense_cloud", types.PointCloud2, latched=True)
        agent = {"agents": ("anna",), "connect": (address,), "light.landmarks": 5}
        post = {"role": "post", "agents": ("anna",), "listen": (address,)}
        image = np.full((120, 160, 3), (200, 40, 10), dtype=np.uint8)
        depth = np.full((120, 160), WALL_M, dtype=np.float32)
        with (
            node(environment, "slam_radio", "radio_link", log, **post),
            node(environment, "slam_radio", "radio_link", log, "helmet", **agent),
            node(environment, "dense_mapping", "dense_mapper", log, agents=("anna",), **{"tsdf.min_images": 1}),
        ):
            start = submap.start_stamp_ns
            odometry = odometry_message(types, "odom", "base_link", PoseEstimate(start, np.eye(4), np.eye(6)))

            def is_up() -> bool:
                probe.send("/helmet/odom", odometry)
                return bool(probe.received["/anna/odom"])

            probe.wait(is_up, f"no pose at the post: {log.read_text()}")
            header = header_message(types, stamp, "left_optical")
            probe.send("/helmet/stereo/left/image_rect", image_message(types, header, image, "rgb8"))
            sigma = np.full_like(depth, 0.01)
            messages = depth_messages(types, DepthImage(stamp, depth, sigma, CAMERA, frame_id="tof_optical"))
            for name, message in zip(("depth/image", "noise/image", "camera_info"), messages[:3], strict=True):
                probe.send(f"/helmet/tof/{name}", message)
            views = tmp_path / "state/indoor_slam/helmet/radio/views/anna"
            for topic, message in zip(SUBMAP_TOPICS, submap_messages(types, submap), strict=True):
                senders[topic].publish(message)
            probe.wait(lambda: len(list(views.glob("*.view"))) == 2, f"no images are kept: {log.read_text()}")
            inbox = tmp_path / "state/indoor_slam/radio/inbox/anna"
            probe.wait(lambda: bool(list(inbox.glob("*.submap"))), f"no submap at the post: {log.read_text()}")
            poses = [PoseEstimate(p.stamp_ns, T_MAP_START @ p.T, np.eye(6)) for p in submap.path]
            probe.send("/anna/map/path", path_message(types, submap.end_stamp_ns, "map", poses))

            def asked(topic: str, frame: str, point: Any = (0.0, 0.0, 0.0), seconds: int = 0) -> None:
                x, y, z = map(float, point)
                wanted = types.PointStamped(
                    header=header_message(types, seconds * 10**9, frame), point=types.Point(x=x, y=y, z=z)
                )
                probe.send(topic, wanted)

            ahead = poses[1].T @ [WALL_M, 0.0, 0.0, 1.0]
            asked("/wanted_picture", "map", ahead[:3])
            pictures = probe.received["/anna/view/picture/compressed"]
            probe.wait(lambda: bool(pictures), f"no picture: {log.read_text()}")
            asked("/wanted_key_frame", "anna")
            probe.wait(lambda: bool(probe.received["/map/dense_cloud"]), f"no depth: {log.read_text()}")

            def is_refused(frame: str, text: str, **more: int) -> bool:
                asked("/wanted_picture", frame, **more)
                return text in log.read_text()

            probe.wait(lambda: is_refused("bert", "or of an agent: 'bert'"), "an unknown agent is not refused")
            probe.wait(lambda: is_refused("anna", "no submap of anna", seconds=1000), "no moment is refused")
    assert stamp_ns(pictures[0]) == stamp
    found = colour_from_message(pictures[0])
    assert found.shape == (120, 160, 3)
    assert np.abs(found.astype(int) - image).max() < 20
    expected = T_MAP_START @ submap.path[1].T @ T_BASE_CAMERA
    np.testing.assert_allclose(pose_from_message(probe.received["/anna/view/pose"][0].pose), expected, atol=1e-5)
    cloud = cloud_from_message(probe.received["/map/dense_cloud"][-1])
    points = np.stack([cloud[axis] for axis in "xyz"] + [np.ones(len(cloud))], axis=1).astype(np.float64)
    in_camera = points @ np.linalg.inv(expected).T
    assert len(points) > 100
    np.testing.assert_allclose(in_camera[:, 2], WALL_M, atol=0.02)
    assert "Traceback" not in log.read_text()
