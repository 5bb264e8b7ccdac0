# SPDX-License-Identifier: Apache-2.0
"""A long way that comes back nowhere, and positions of the rig's antenna in the frame of the building."""

from __future__ import annotations

import numpy as np
from submap_world import Agent, Sensor, World, path_through, room

from slam_core.geometry import FloatArray, boxplus, transform_points
from slam_core.types import PositionReading

ARM = np.array([0.1, -0.2, 0.5])
SIGMA = 0.1
T_BUILDING_WORLD = boxplus(np.eye(4), np.array([120.0, -45.0, 8.0, 0.02, -0.03, 2.1]))


def drive(seed: int) -> Agent:
    """A way of 60 m through rooms, that comes back nowhere."""
    rng = np.random.default_rng(seed)
    corners = [(0.0, 0.0), (20.0, 0.0), (20.0, 15.0), (40.0, 15.0), (40.0, 20.0)]
    points = [room((x, y), (8.0, 8.0), 150, rng) for x, y in [*corners, (10.0, 0.0), (20.0, 8.0), (30.0, 15.0)]]
    world = World.random(np.concatenate(points), rng)
    sensor = Sensor(6.0, sigma_bearing=0.006, sigma_depth=0.01, odometry=(0.04, 0.01), max_landmarks=15)
    return Agent(world, path_through(corners), rng, "a", sensor, steps=8)


def positions(agent: Agent, seed: int, every: int = 2, outliers: float = 0.0) -> tuple[list[PositionReading], int]:
    """Readings along the true way, and how many of them are 5 m off."""
    rng, out, bad = np.random.default_rng([seed, 9]), [], 0
    for k in range(every, agent.steps * ((len(agent.path) - 1) // agent.steps) + 1, every):
        place = transform_points(T_BUILDING_WORLD @ agent.path[k], ARM[None])[0] + SIGMA * rng.normal(size=3)
        if rng.random() < outliers:
            place, bad = place + 5.0 * unit(rng.normal(size=3)), bad + 1
        out.append(PositionReading(agent.stamp_ns + int(k * 1e8), place, SIGMA**2 * np.eye(3)))
    return out, bad


def unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v))
