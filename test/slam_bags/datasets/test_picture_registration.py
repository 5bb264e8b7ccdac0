# SPDX-License-Identifier: Apache-2.0
"""A picture taken from beside the depth camera lands where the depth camera sees the same points."""

from __future__ import annotations

import cv2
import numpy as np

from slam_bags.datasets.picture_registration import ColourCamera, register_pictures
from slam_core.camera import Camera

DEPTH_CAMERA = Camera(320, 240, 290.0, 290.0, 160.0, 120.0)
COLOUR = ColourCamera((262.0, 262.0, 158.0, 121.0), (0.03, 0.0, 0.0))


def picture_of_wall(rng, z):
    """A textured wall at depth z as both cameras see it."""
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (600, 800)).astype(np.float32), (0, 0), 4)
    texture = (255 * (texture - texture.min()) / np.ptp(texture)).astype(np.float32)

    def view(fx, cx, cy, shift):
        u, v = np.meshgrid(np.arange(320), np.arange(240))
        x, y = (u - cx) / fx * z + shift, (v - cy) / fx * z
        return cv2.remap(
            texture, (x * 150 + 400).astype(np.float32), (y * 150 + 300).astype(np.float32), cv2.INTER_LINEAR
        )

    return view(290.0, 160.0, 120.0, 0.0), view(262.0, 158.0, 121.0, 0.03)


def test_registered_picture_is_what_the_depth_camera_would_see(rng):
    own, other = picture_of_wall(rng, 2.0)
    depth = np.full((240, 320), 2.0)
    depth[100:110, 50:200] = 0.0
    grey, colour = other.astype(np.uint8), np.repeat(other.astype(np.uint8)[..., None], 3, axis=2)
    registered, coloured = (p.astype(float) for p in register_pictures((grey, colour), depth, DEPTH_CAMERA, COLOUR))
    np.testing.assert_array_equal(coloured[..., 1], registered)
    inside = np.s_[20:220, 30:290]
    assert np.abs(registered[inside] - own[inside]).mean() < 1.5
    assert np.abs(other[inside] - own[inside]).mean() > 10.0


def test_a_frame_without_any_depth_keeps_its_picture(rng):
    grey = rng.integers(0, 255, (240, 320), dtype=np.uint8)
    (as_it_was,) = register_pictures((grey,), np.zeros((240, 320)), DEPTH_CAMERA, COLOUR)
    np.testing.assert_array_equal(as_it_was, grey)
