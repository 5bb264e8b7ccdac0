# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from slam_core.frame_tree import FrameTree
from slam_core.geometry import boxplus, invert_transform


def test_lookup_along_a_chain_and_back(rng: np.random.Generator) -> None:
    T = {name: boxplus(np.eye(4), rng.normal(size=6)) for name in "abc"}
    tree = FrameTree()
    tree.add("base", "left", T["a"])
    tree.add("left", "tof", T["b"])
    tree.add("base", "imu", T["c"])
    np.testing.assert_allclose(tree.lookup("base", "tof"), T["a"] @ T["b"], atol=1e-12)
    np.testing.assert_allclose(tree.lookup("tof", "imu"), invert_transform(T["a"] @ T["b"]) @ T["c"], atol=1e-12)
    np.testing.assert_array_equal(tree.lookup("nowhere", "nowhere"), np.eye(4))


def test_a_missing_transform_is_never_identity() -> None:
    tree = FrameTree()
    tree.add("base", "left", np.eye(4))
    with pytest.raises(ValueError, match="no transform from 'tof' to 'base' \\(known frames: base, left\\)"):
        tree.lookup("base", "tof")


def test_what_is_not_rigid_is_refused() -> None:
    with pytest.raises(ValueError, match="not rigid"):
        FrameTree().add("a", "b", 2 * np.eye(4))


def test_a_newer_transform_replaces_the_old_one() -> None:
    tree = FrameTree()
    moved = np.eye(4)
    moved[0, 3] = 1.0
    tree.add("a", "b", np.eye(4))
    tree.lookup("a", "b")[0, 3] = 7.0
    np.testing.assert_array_equal(tree.lookup("a", "b"), np.eye(4))
    tree.add("a", "b", moved)
    np.testing.assert_array_equal(tree.lookup("a", "b"), moved)
    assert "b" in tree
    assert tree.frames == ("a", "b")
