# SPDX-License-Identifier: Apache-2.0
"""Which namespaces of a bag are cameras of one rig, and what a ``rig.yaml`` says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam_bags.reading.rig_cameras import rigs_of
from slam_bags.reading.rig_file import read_rig_cameras
from slam_core.frame_tree import FrameTree


def tree_of(*edges: tuple[str, str]) -> FrameTree:
    tree = FrameTree()
    for parent, child in edges:
        tree.add(parent, child, np.eye(4))
    return tree


def test_cameras_in_one_tree_are_one_rig() -> None:
    tree = tree_of(("base_link", "f"), ("base_link", "mount"), ("mount", "b"))
    assert rigs_of({"front": ["f"], "back": ["b"]}, tree) == {"": ("back", "front")}
    depth_in_left = {"front": ["f", "f"], "back": ["b"]}
    assert rigs_of(depth_in_left, tree) == {"": ("back", "front")}
    assert rigs_of(depth_in_left, tree, ["/imu", "/odometry", "/front/imu"]) == {"": ("back", "front")}


def test_the_cameras_of_an_agent_are_a_level_lower() -> None:
    tree = tree_of(("a/base_link", "f"), ("a/base_link", "b"), ("c/base_link", "x"))
    assert rigs_of({"a/front": ["f"], "a/back": ["b"], "c": ["x"]}, tree) == {"a": ("a/back", "a/front"), "c": ("c",)}


@pytest.mark.parametrize(
    ("frames", "edges"),
    [
        ({"ann": ["f"], "ben": ["f"]}, [("base_link", "f")]),  # one frame for both: two rigs of one make
        ({"ann": ["f"], "ben": ["b"]}, [("base_link", "f"), ("ben/base_link", "b")]),  # a base of its own
        ({"ann": ["f"], "ben": ["b"]}, [("base_link", "f"), ("other", "b")]),  # not in one tree
        ({"ann": ["f"], "ben": ["b"]}, [("ann/base_link", "f"), ("ben/base_link", "b")]),
        ({"ann": ["f"], "ben": []}, [("base_link", "f")]),  # no frame known
    ],
)
def test_agents_stay_agents(frames: dict[str, list[str]], edges: list[tuple[str, str]]) -> None:
    assert rigs_of(frames, tree_of(*edges)) == {"ann": ("ann",), "ben": ("ben",)}


def test_one_camera_at_the_root_is_a_rig_beside_none() -> None:
    assert rigs_of({"": ["f"]}, tree_of(("base_link", "f"))) == {"": ("",)}


def test_a_file_lists_topics_and_transforms(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "cameras:\n  front: {left: /a/left, right: /a/right}\n  back: {depth: b/depth}\n"
        "transforms:\n  - base_link b -0.1 0 0 0.5 0.5 -0.5 -0.5\n"
    )
    rig = read_rig_cameras(path)
    assert rig.topics == {"front": {"left": "/a/left", "right": "/a/right"}, "back": {"depth": "/b/depth"}}
    assert [t.child for t in rig.transforms] == ["b"]
    np.testing.assert_allclose(rig.transforms[0].T[:3, 3], [-0.1, 0.0, 0.0])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("cameras: [front]", "mapping of names"),
        ("rigs: {}", "may hold"),
        ("cameras: {}", "one to 8 cameras"),
        ("cameras: {front: {lft: /a}}", "role"),
        ("cameras: {front: {imu: /imu}}", "camera 'front' has no topic"),
        ("cameras: {front: {depth: /a}, back: {imu: /imu}}", "camera 'back' has no topic"),
        ("cameras: {'a b': {depth: /a}}", "no name for a camera"),
        ("cameras: {a: {depth: /a}}\ntransforms: [base_link a 1 2 3]", "PARENT CHILD"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        read_rig_cameras(path)
