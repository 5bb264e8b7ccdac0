# SPDX-License-Identifier: Apache-2.0
"""The ``dense_mapper`` node over real topics: nothing before the path, then a cloud and a plan, moved with the path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402

from dense_mapping.node import DenseMapperNode  # noqa: E402
from dense_mapping.plans.floor_plan import OCCUPIED  # noqa: E402
from slam_core.camera import Camera  # noqa: E402
from slam_core.geometry import OPTICAL_FROM_RIG, make_transform  # noqa: E402
from slam_core.messages import (  # noqa: E402
    depth_messages,
    header_message,
    image_message,
    imu_message,
    occupancy_from_message,
    odometry_message,
    path_message,
    points_from_message,
    pose_with_covariance_message,
    rectified_info,
)
from slam_core.ros import RosTypes  # noqa: E402
from slam_core.types import DepthImage, ImuSample, PoseEstimate  # noqa: E402
from stereo_frontend.sources import RawPair  # noqa: E402
from stereo_frontend.stereo.rectification_error import NAMES, RectificationError  # noqa: E402

pytestmark = pytest.mark.ros

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)
TYPES = RosTypes()


@pytest.fixture
def node(domain: int):
    rclpy.init(args=["--ros-args", "-p", "keyframe.distance:=0.1"])
    made = DenseMapperNode()
    sent: dict[str, list] = {}
    made.publish = lambda topic, message: sent.setdefault(topic, []).append(message)
    made.sent = sent
    made.frames.add("base_link", "tof_optical_frame", make_transform(OPTICAL_FROM_RIG.T, np.array([0, 0, 0.0])))
    executor = SingleThreadedExecutor()
    executor.add_node(made)
    yield made
    executor.shutdown(timeout_sec=2.0)
    made.destroy_node()
    rclpy.try_shutdown()


def estimate(stamp: int, x: float) -> PoseEstimate:
    return PoseEstimate(stamp, make_transform(np.eye(3), np.array([x, 0.0, 1.2])), 1e-6 * np.eye(6))


def wall_image(stamp: int, distance: float) -> DepthImage:
    """A wall across the rig's way."""
    depth = np.full((60, 80), distance, dtype=np.float32)
    return DepthImage(stamp, depth, np.full_like(depth, 0.01), CAMERA, frame_id="tof_optical_frame")


def drive(node: DenseMapperNode, shift: float = 0.0) -> list[PoseEstimate]:
    """Three metres before a wall at x = 3, and towards it in steps."""
    poses = [estimate((k + 1) * 10**8, 0.15 * k) for k in range(5)]
    for pose in poses:
        node._on_odometry("", odometry_message(TYPES, "odom", "base_link", pose))
        messages = depth_messages(TYPES, wall_image(pose.stamp_ns, 3.0 - float(pose.T[0, 3])))
        node._on_depth("", messages.depth, messages.noise, messages.camera_info)
    return poses


def test_key_frames_wait_for_the_path_and_move_with_it(node):
    poses = drive(node)
    assert node.mapper.waiting == 5
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    assert node.mapper.waiting == 0
    node._publish_news()
    points = points_from_message(node.sent["map/dense_cloud"][-1])
    assert len(points) > 100
    assert abs(np.median(points[:, 0]) - 3.0) < 0.01
    cells, resolution, T_map_plan = occupancy_from_message(node.sent["map/occupancy"][-1])
    row, column = np.argwhere(cells == OCCUPIED)[0]
    place = T_map_plan @ [(column + 0.5) * resolution, (row + 0.5) * resolution, 0.0, 1.0]
    assert abs(place[0] - 3.0) < 0.06

    moved = [estimate(p.stamp_ns, float(p.T[0, 3]) + 0.5) for p in poses]
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", moved))
    node._publish_news()
    points = points_from_message(node.sent["map/dense_cloud"][-1])
    assert abs(np.median(points[:, 0]) - 3.5) < 0.01, "the wall moved with the trajectory"
    assert np.all(points[:, 0] > 3.3), "and nothing of it stayed where it was"


def test_an_image_of_a_camera_nobody_mounted_is_rejected(node):
    image = wall_image(10**8, 2.0)
    messages = depth_messages(TYPES, DepthImage(10**8, image.depth, image.sigma, CAMERA, frame_id="elsewhere"))
    with pytest.raises(ValueError, match="elsewhere"):
        node._on_depth("", messages.depth, messages.noise, messages.camera_info)


def test_reset_forgets_the_model_and_save_writes_it(node, tmp_path):
    poses = drive(node)
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    object.__setattr__(node.config, "output_path", str(tmp_path / "dense"))
    response = node._on_save(None, type("Response", (), {})())
    assert response.success, response.message
    assert {p.name for p in (tmp_path / "dense").iterdir()} == {"mesh.ply", "floor_plan.yaml", "floor_plan.pgm"}
    node.on_reset()
    assert not node.mapper.model.keyframes


def test_a_new_session_keeps_what_is_in_the_model(node):
    poses = drive(node)
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    drive(node)
    node.on_new_session()
    assert len(node.mapper.model.keyframes) == 5
    assert node.mapper.waiting == 0


def test_key_frames_take_the_colour_of_their_time_whether_it_comes_before_or_after(node):
    poses = [estimate((k + 1) * 10**8, 0.15 * k) for k in range(5)]

    def send_colour(pose: PoseEstimate) -> None:
        red = np.full((60, 80, 3), (200, 10, 10 * round(pose.stamp_ns / 1e8)), np.uint8)
        header = header_message(TYPES, pose.stamp_ns + 10**7, "tof_optical_frame")
        node._on_colour("", "tof", image_message(TYPES, header, red, "rgb8"))

    for k, pose in enumerate(poses):
        node._on_odometry("", odometry_message(TYPES, "odom", "base_link", pose))
        if k % 2:
            send_colour(pose)
        messages = depth_messages(TYPES, wall_image(pose.stamp_ns, 3.0 - float(pose.T[0, 3])))
        node._on_depth("", messages.depth, messages.noise, messages.camera_info)
        if k in (0, 2):
            send_colour(pose)
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    pictures = [k.keyframe.picture for k in node.mapper.model.keyframes]
    assert [tuple(p[30, 40]) if p.size else () for p in pictures[:4]] == [(200, 10, 10 * (k + 1)) for k in range(4)]
    assert pictures[4].size == 0, "the last one's was never sent"


def test_gravity_levels_the_plan_of_a_rig_that_started_tilted(node):
    poses = drive(node)
    up = np.array([0.3, 0.0, 9.8]) / np.linalg.norm([0.3, 0.0, 9.8])
    for pose in poses:
        node._on_imu("", imu_message(TYPES, "base_link", ImuSample(pose.stamp_ns, np.zeros(3), 9.81 * up)))
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    node._publish_news()
    T_map_plan = occupancy_from_message(node.sent["map/occupancy"][-1])[2]
    np.testing.assert_allclose(T_map_plan[:3, 2], up, atol=1e-3)


def test_pairs_are_rectified_as_the_front_end_has_found_out(node):
    stage = node._pairs[""]
    info = rectified_info(CAMERA), rectified_info(CAMERA, 0.1)
    for side, each in zip(("left", "right"), info, strict=True):
        stage.set_info(side, each)
    error = RectificationError(CAMERA, np.linspace(1e-4, 2e-3, len(NAMES)), np.eye(len(NAMES)))
    rng = np.random.default_rng(1)
    pair = RawPair(0, *rng.integers(0, 256, (2, 60, 80), dtype=np.uint8), "stereo_left_optical_frame")

    def rights(text: str) -> np.ndarray:
        values = [KeyValue(key="correction", value=text)]
        status = DiagnosticStatus(name="/feature_extractor", level=bytes([0]), values=values)
        node._on_diagnostics(DiagnosticArray(status=[status]))
        stage.add(pair)
        return next(stage.ready()).right.astype(float)

    plain, corrected = rights(""), rights(error.text)
    assert np.abs(plain - corrected).mean() > 1.0
    np.testing.assert_array_equal(rights(""), plain)


def test_the_storey_of_a_rig_is_told_with_its_plan(node):
    poses = drive(node)
    node._on_path("", path_message(TYPES, poses[-1].stamp_ns, "map", poses))
    node._publish_news()
    (lowest,) = node._plans
    T = lowest.T_map_plan.copy()
    T[2, 3] += 3.0
    node._plans = (lowest, replace(lowest, T_map_plan=T))
    place = np.linalg.inv(node._plans[0].T_map_plan)
    for up in (1.2, 1.3, 4.0, 4.2, 1.2):
        pose = PoseEstimate(10**9, make_transform(np.eye(3), np.array([0.0, 0.0, up]) - place[:3, 3]), np.eye(6))
        node._on_pose("", pose_with_covariance_message(TYPES, "map", pose))
    assert [message.data for message in node.sent["storey"]] == [0, 1, 0]
    heights = [occupancy_from_message(message)[2][2, 3] for message in node.sent["storey/occupancy"]]
    assert heights == pytest.approx([lowest.T_map_plan[2, 3], T[2, 3], lowest.T_map_plan[2, 3]])
    node._publish_model()
    assert node.sent["storey"][-1].data == 0, "a new model tells it again"
    node.on_reset()
    node._on_pose("", pose_with_covariance_message(TYPES, "map", pose))
    assert len(node.sent["storey"]) == 4
