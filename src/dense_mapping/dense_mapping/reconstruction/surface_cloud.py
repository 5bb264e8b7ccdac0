# SPDX-License-Identifier: Apache-2.0
"""A surface as the points of ``map/dense_cloud``."""

from __future__ import annotations

import numpy as np

from dense_mapping.reconstruction.surface import Surface
from slam_core.types import AnyArray

CLOUD_DTYPE = np.dtype([(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", "sigma")])
"""Fields of ``map/dense_cloud``; ``rgb`` as PCL and RViz pack it."""


def cloud_of(surface: Surface) -> AnyArray:
    """Structured array (n,) of :data:`CLOUD_DTYPE`."""
    cloud = np.empty(len(surface), dtype=CLOUD_DTYPE)
    for axis, name in enumerate("xyz"):
        cloud[name], cloud[f"normal_{name}"] = surface.points[:, axis], surface.normals[:, axis]
    red, green, blue = surface.colours.astype(np.uint32).T
    cloud["rgb"] = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
    cloud["sigma"] = surface.sigma
    return cloud
