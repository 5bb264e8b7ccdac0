# SPDX-License-Identifier: Apache-2.0
"""A room of axis-aligned boxes and a range camera in it, cast by slabs in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from slam_core.geometry import FloatArray, make_transform, rotation_from_euler


@dataclass(frozen=True)
class Room:
    """From the origin to ``size`` m, with boxes (n, 2, 3): lower and upper corners."""

    size: FloatArray
    boxes: FloatArray

    def ranges(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions
        nearest = np.where(inverse > 0, (self.size - origin) * inverse, -origin * inverse).min(axis=1)
        for low, high in self.boxes:
            a, b = (low - origin) * inverse, (high - origin) * inverse
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            nearest = np.where((enter < leave) & (enter > 0) & (enter < nearest), enter, nearest)
        return nearest

    def scan(self, T: FloatArray, rng: np.random.Generator, size: int = 90, sigma: float = 0.003) -> FloatArray:
        """Points (size * size, 3) of a 40 degree camera at T_room_rig, X forward; noise grows with range squared."""
        c = (np.arange(size) - 0.5 * (size - 1)) / (0.5 * size) * np.tan(np.deg2rad(20.0))
        v, u = np.meshgrid(c, c, indexing="ij")
        rays = np.stack([np.ones_like(u), -u, -v], axis=-1).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ranges = self.ranges(T[:3, 3], rays @ T[:3, :3].T)
        return rays * (ranges + rng.normal(size=len(ranges)) * sigma * (ranges / 2.0) ** 2)[:, None]


def pose(x: float, y: float, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> FloatArray:
    """A pose of metres and degrees."""
    return make_transform(rotation_from_euler(*np.deg2rad([yaw, pitch, roll])), np.array([x, y, z]))


BOXES = [
    [(4.0, 0.4, 0.0), (4.8, 1.3, 1.4)],
    [(4.3, 1.9, 0.0), (5.2, 2.4, 0.9)],
    [(4.6, 2.9, 0.0), (5.4, 3.9, 1.7)],
    [(3.4, 3.2, 0.0), (3.9, 3.7, 0.8)],
    [(5.3, 1.4, 1.2), (5.6, 2.7, 1.6)],
    [(3.2, 0.5, 0.0), (3.5, 0.9, 1.0)],
    [(5.4, 0.2, 1.6), (5.9, 1.1, 2.2)],
]


@pytest.fixture(scope="session")
def room() -> Room:
    return Room(np.array([6.0, 4.2, 2.5]), np.array(BOXES))


@pytest.fixture(scope="session")
def start() -> FloatArray:
    return pose(1.0, 2.0, 1.2, 0.0)


@pytest.fixture(scope="session")
def at() -> Callable[..., FloatArray]:
    """``pose`` for tests, which cannot import this file."""
    return pose


@pytest.fixture(scope="session")
def empty_room() -> Callable[[float, float, float], Room]:
    return lambda x, y, z: Room(np.array([x, y, z]), np.empty((0, 2, 3)))
