# SPDX-License-Identifier: Apache-2.0
"""A simulated room with a depth camera that turns round in its middle, for tests of the dense model."""

from __future__ import annotations

import numpy as np

from dense_mapping.reconstruction.surface import Surface
from slam_core.camera import Camera
from slam_core.geometry import OPTICAL_FROM_RIG, make_transform, rotation_from_euler
from slam_core.types import DepthImage
from slam_simulation.rendering.raycaster import camera_rays, make_view, trace
from slam_simulation.rendering.surface_distance import distance_to_surfaces
from slam_simulation.scenario import Scenario
from slam_simulation.world.surface_table import compile_world

CAMERA = Camera(160, 120, 90.0, 90.0, 79.5, 59.5)
SIGMA = 0.01
ROOM = {
    "seed": 3,
    "rate": 10.0,
    "frames": 10,
    "rooms": [{"name": "room", "x": [0, 4], "y": [0, 3], "style": "office"}],
    "agents": [{"motion": "rig", "height": 1.2, "path": [[1, 1], [3, 2, 90]]}],
}


class Room:
    """A furnished room with a depth camera that turns round in its middle."""

    def __init__(self) -> None:
        scenario = Scenario.from_mapping("room", ROOM)
        self.world = scenario.world()
        self._table, self._rays = compile_world(self.world), camera_rays(CAMERA)
        self.poses = [self._pose(k) for k in range(12)]

    def _pose(self, k: int) -> np.ndarray:
        yaw = 2 * np.pi * k / 12
        R = rotation_from_euler(yaw, 0.25) @ OPTICAL_FROM_RIG.T
        return make_transform(R, np.array([2.0 - 0.3 * np.cos(yaw), 1.5 - 0.3 * np.sin(yaw), 1.3]))

    def depth(self, k: int, rng: np.random.Generator, scale: float = 1.0) -> DepthImage:
        hits = trace(make_view(self._table, self.poses[k], self._rays.bounds), self._rays)
        depth = np.where(hits.depth > 0, hits.depth + rng.normal(0, SIGMA, hits.depth.shape), np.nan).astype(np.float32)
        sigma = np.full_like(depth, SIGMA)
        return DepthImage(k, scale * depth, sigma, CAMERA, amplitude=np.full_like(depth, 100.0))

    def errors(self, surface: Surface) -> np.ndarray:
        return distance_to_surfaces(self.world, surface.points.astype(np.float64))
