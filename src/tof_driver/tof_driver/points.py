# SPDX-License-Identifier: Apache-2.0
"""The point cloud of a depth image: organised like the image, each point with the standard deviation of its depth."""

from __future__ import annotations

import numpy as np

from slam_core.types import AnyArray, DepthImage

POINT_DTYPE = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])
"""x, y, z in the optical frame (m) and sigma of z (m); all NaN where there is no depth."""


def depth_cloud(image: DepthImage) -> AnyArray:
    """Structured array of :data:`POINT_DTYPE`, shape (height, width)."""
    cloud = np.empty(image.depth.shape, dtype=POINT_DTYPE)
    points = image.points()
    for axis, name in enumerate("xyz"):
        cloud[name] = points[..., axis]
    cloud["sigma"] = image.sigma
    return cloud
