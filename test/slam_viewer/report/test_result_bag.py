# SPDX-License-Identifier: Apache-2.0
"""``result.mcap`` and its layout by Foxglove's rules: known schemas, one tree of frames, the bag's own time.

Schemas: docs.foxglove.dev/docs/visualization/panels/3d ("Supported messages") and .../panels/image.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dense_mapping.reconstruction.surface import Surface
from slam_bags.nodes.recording_clock import RecordingClock
from slam_bags.storage.bag import BagReader, BagWriter
from slam_bags.storage.bag_types import BagTypes
from slam_core.frame_tree import FrameTree
from slam_core.messages import (
    path_message,
    pose_from_message,
    stamp_ns,
    transform_from_message,
    transform_message,
)
from slam_core.trajectory import Trajectory, read_trajectory
from slam_viewer.report.foxglove import layout
from slam_viewer.report.result_bag import complete_recording
from slam_viewer.results import AgentResult, LandmarkMap, RunResult

SCENE = {
    f"{package}/msg/{name}"
    for package, names in {
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped"),
        "nav_msgs": ("Path", "OccupancyGrid"),
        "sensor_msgs": ("PointCloud2", "CompressedImage", "CameraInfo"),
        "visualization_msgs": ("MarkerArray",),
    }.items()
    for name in names
}

EMPTY = RunResult(
    "bag", "tof", "sjsam", "none", (), LandmarkMap.empty(), Surface.empty(), (), 0, 0, 0, {}, {}, 0.0, 0.0, {}
)


def messages(out: Path) -> list:
    with BagReader(out / "result.mcap") as bag:
        return list(bag.messages())


@pytest.mark.slow
def test_it_spans_the_time_of_the_bag_and_holds_pictures_features_and_the_whole_map_at_once(out):
    read = messages(out)
    stamps = [m.stamp_ns for m in read]
    estimate = read_trajectory(out / "trajectory.tum")
    assert (min(stamps), max(stamps)) == (estimate.stamps_ns[0], estimate.stamps_ns[-1])
    at_once = {m.topic for m in read if m.stamp_ns == stamps[0]}
    assert {
        "/tf_static", "/tf", "/map/dense_cloud", "/map/occupancy", "/map/graph", "/map/path", "/ground_truth/path",
        "/features/image/compressed", "/features", "/features/camera_info", "/pose",
    } <= at_once  # fmt: skip
    pictures = [m for m in read if m.topic == "/features/image/compressed"]
    assert len(pictures) == 26, "every second frame of 5 Hz: up to four pictures a second"
    assert all(bytes(m.message.data[:2]) == b"\xff\xd8" for m in pictures), "each is a JPEG file"


@pytest.mark.slow
def test_every_frame_hangs_on_the_map_and_has_one_parent(out):
    tree, parents, used = FrameTree(), {}, set()
    for topic, _, message in messages(out):
        for transform in message.transforms if topic.startswith("/tf") else ():
            parent, child, T = transform_from_message(transform)
            assert parents.setdefault(child, parent) == parent
            tree.add(parent, child, T)
        if hasattr(message, "header"):
            used.add(message.header.frame_id)
        used |= {marker.header.frame_id for marker in getattr(message, "markers", ())}
    assert {"map", "world", "stereo_left_optical_frame", "odom"} <= used
    for frame in used:
        tree.lookup("map", frame)


@pytest.mark.slow
def test_the_truth_lies_on_the_trajectory(out):
    read = messages(out)
    statics = [transform_from_message(t) for m in read if m.topic == "/tf_static" for t in m.message.transforms]
    T_map_world = next(T for parent, child, T in statics if (parent, child) == ("map", "world"))
    estimate = read_trajectory(out / "trajectory.tum")
    poses = dict(zip(estimate.stamps_ns.tolist(), estimate.poses, strict=True))
    gaps = [
        np.linalg.norm((T_map_world @ pose_from_message(m.message.pose))[:3, 3] - poses[stamp_ns(m.message)][:3, 3])
        for m in read
        if m.topic == "/ground_truth/pose" and stamp_ns(m.message) in poses
    ]
    assert len(gaps) >= 50
    assert max(gaps) < 0.02


def test_a_recording_of_the_nodes_is_completed_by_what_only_the_end_knows(tmp_path):
    """Dense model, floor plan and truth are added; what was recorded stays, and no frame gets a second parent."""
    types, path = BagTypes(), tmp_path / "result.mcap"
    with BagWriter(path) as bag:
        statics = [transform_message(types, 50, "base_link", "tof_optical_frame", np.eye(4))]
        bag.write("/tf_static", types.TFMessage(transforms=statics), 50)
        bag.write("/map/path", path_message(types, 90, "map", []), 90)
        bag.write("/map/graph", types.MarkerArray(markers=[]), 90)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = range(4)
    way = Trajectory(np.arange(60, 100, 10), poses)
    agent = AgentResult("", way, filtered=way, truth=way, mounts={"tof_optical_frame": np.eye(4)})
    complete_recording(path, replace(EMPTY, agents=(agent,)))
    with BagReader(path) as bag:
        read = list(bag.messages())
    topics = [m.topic for m in read]
    assert {"/map/dense_cloud", "/ground_truth/path"} <= set(topics)
    assert topics.count("/map/path") == topics.count("/map/graph") == 1
    children = [t.child_frame_id for m in read if m.topic == "/tf_static" for t in m.message.transforms]
    assert sorted(children) == ["tof_optical_frame", "world"]
    assert {m.stamp_ns for m in read} == {50, 90}


KEYS = {
    "3D": "foxglovePanelTitle followMode followTf cameraState scene transforms topics",
    "Image": "foxglovePanelTitle imageMode",
    "Plot": "foxglovePanelTitle paths showLegend isSynced xAxisVal",
    "cameraState": "distance perspective phi target targetOffset targetOrientation thetaOffset fovy near far",
    "imageMode": "imageTopic calibrationTopic",
    "path": "value label enabled timestampMethod",
    "sensor_msgs/msg/PointCloud2": "visible colorMode colorField colorMap flatColor pointSize",
    "nav_msgs/msg/OccupancyGrid": "visible colorMode alpha",
    "nav_msgs/msg/Path": "visible type lineWidth gradient",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "visible type color showCovariance",
    "visualization_msgs/msg/MarkerArray": "visible",
}
"""Settings that Foxglove knows, of those that we set: names of foxglove.layouts in foxglove-sdk 0.30.3, in camel case.

A panel's title has another name in the files that the app exports.
"""
VALUES = {
    "colorMode": {"flat", "gradient", "colormap", "rgb", "rgba", "rgba-fields", "custom", "costmap", "map", "raw"},
    "colorMap": {"turbo", "rainbow"}, "type": {"axis", "arrow", "line"}, "xAxisVal": {"timestamp"},
    "followMode": {"follow-pose", "follow-heading", "follow-position", "follow-none"},
    "timestampMethod": {"receiveTime", "publishTime", "headerStamp", "customField"},
}  # fmt: skip


def assert_known(settings: dict, kind: str) -> None:
    assert set(settings) <= set(KEYS[kind].split()), kind
    for key, value in settings.items():
        assert key not in VALUES or value in VALUES[key], (kind, key, value)


@pytest.mark.slow
def test_the_layout_has_panels_and_settings_that_foxglove_knows(out):
    with BagReader(out / "result.mcap") as bag:
        types = {topic: info.type_name for topic, info in bag.topics.items()}
    read = json.loads((out / "foxglove_layout.json").read_text())
    assert set(read) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    for name, panel in read["configById"].items():
        assert_known(panel, name.split("!")[0])
        assert_known(panel.get("cameraState", {}), "cameraState")
        assert_known(panel.get("imageMode", {}), "imageMode")
        for path in panel.get("paths", []):
            assert_known(path, "path")
        for topic, settings in panel.get("topics", {}).items():
            assert_known(settings, types[topic])


@pytest.mark.slow
def test_the_layout_names_topics_that_are_there_of_types_that_the_panels_show(out):
    with BagReader(out / "result.mcap") as bag:
        types = {topic: info.type_name for topic, info in bag.topics.items()}
    read = json.loads((out / "foxglove_layout.json").read_text())
    panels = read["configById"]
    assert set(panels) == set(leaves(read["layout"]))
    scene = panels["3D!map"]["topics"]
    assert {"/map/dense_cloud", "/map/occupancy", "/map/path", "/ground_truth/path", "/pose"} <= set(scene)
    assert all(types[topic] in SCENE for topic in scene)
    image = panels["Image!0"]["imageMode"]
    assert types[image["imageTopic"]] == "sensor_msgs/msg/CompressedImage"
    assert types[image["calibrationTopic"]] == "sensor_msgs/msg/CameraInfo"
    assert [path["value"].split(".")[0] for path in panels["Plot!sigma"]["paths"]] == ["/pose", "/pose"]


def leaves(node) -> list[str]:
    return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]


def test_several_agents_have_a_picture_each_and_a_colour_each():
    topics = [f"/{a}/{t}" for a in ("one", "two") for t in ("map/path", "pose", "features/image/compressed")]
    read = layout(topics)
    assert leaves(read["layout"]) == ["3D!map", "Image!0", "Image!1", "Plot!sigma"]
    scene = read["configById"]["3D!map"]["topics"]
    assert scene["/one/pose"]["color"] != scene["/two/pose"]["color"]
    assert [p["label"] for p in read["configById"]["Plot!sigma"]["paths"]] == ["one x", "one y", "two x", "two y"]


def test_messages_without_a_stamp_get_the_newest_one_and_the_first_ones_wait_for_it():
    clock = RecordingClock()
    assert list(clock.stamped("tf_static", 0)) == []
    assert list(clock.stamped("odom 1", 70)) == [("tf_static", 70), ("odom 1", 70)]
    assert list(clock.stamped("markers", 0)) == [("markers", 70)]
    assert list(clock.stamped("late", 60)) == [("late", 60)]
    assert list(clock.stamped("diagnostics", 0)) == [("diagnostics", 70)]
    assert list(RecordingClock().rest(5)) == []
