# SPDX-License-Identifier: Apache-2.0
"""A dense key frame of the radio as messages, and back."""

from __future__ import annotations

import numpy as np
import pytest

from slam_bags.storage.bag_types import BagTypes
from slam_core.camera import Camera
from slam_core.geometry import boxplus
from slam_core.messages.key_frames import (
    KEY_FRAME_TOPICS,
    AnchoredKeyFrame,
    key_frame_from_messages,
    key_frame_messages,
)
from slam_core.types import DepthImage


def made(rng) -> AnchoredKeyFrame:
    depth, sigma = (rng.uniform(0.1, 3.0, (12, 16)).astype(np.float32) for _ in range(2))
    image = DepthImage(5 * 10**9, depth, sigma, Camera(16, 12, 10.0, 11.0, 8.0, 6.0), frame_id="anna")
    T = boxplus(np.eye(4), np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    return AnchoredKeyFrame(image, rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), 4 * 10**9, T)


def test_it_comes_back(rng):
    frame = made(rng)
    messages = key_frame_messages(BagTypes(), frame)
    assert len(messages) == len(KEY_FRAME_TOPICS)
    found = key_frame_from_messages(*messages)
    assert (found.image.stamp_ns, found.start_stamp_ns) == (5 * 10**9, 4 * 10**9)
    assert found.image.camera == frame.image.camera
    np.testing.assert_array_equal(found.image.depth, frame.image.depth)
    np.testing.assert_array_equal(found.image.sigma, frame.image.sigma)
    np.testing.assert_array_equal(found.colours, frame.colours)
    np.testing.assert_allclose(found.T_start_camera, frame.T_start_camera, atol=1e-12)


def test_colours_of_another_size_and_a_path_of_two_poses_are_refused(rng):
    frame = made(rng)
    with pytest.raises(ValueError, match="colours of its size"):
        key_frame_from_messages(*key_frame_messages(BagTypes(), frame._replace(colours=frame.colours[:-1])))
    messages = list(key_frame_messages(BagTypes(), frame))
    messages[4].poses.append(messages[4].poses[0])
    with pytest.raises(ValueError, match="one pose"):
        key_frame_from_messages(*messages)
