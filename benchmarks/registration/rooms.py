"""Furnished rooms and a time-of-flight camera, as small as can be: slab ray casting of axis-aligned boxes in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray, make_transform, rotation_from_euler

SIZE_PX = 204
HALF_FIELD_OF_VIEW = np.deg2rad(20.0)


@dataclass(frozen=True)
class Room:
    """A closed room, from the origin to ``size`` m, with boxes (n, 2, 3): lower and upper corners."""

    size: FloatArray
    boxes: FloatArray

    def ranges(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Distance (n,) m to the first surface along unit directions (n, 3)."""
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions
        walls = np.where(inverse > 0, (self.size - origin) * inverse, -origin * inverse)
        nearest = walls.min(axis=1)
        for low, high in self.boxes:
            a, b = (low - origin) * inverse, (high - origin) * inverse
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (enter < leave) & (enter > 0)
            nearest = np.where(hit & (enter < nearest), enter, nearest)
        return nearest


def furnished_room(
    rng: np.random.Generator, size: tuple[float, float, float] = (6.0, 5.0, 2.6), boxes: int = 12
) -> Room:
    """A room with boxes on the floor and along its walls."""
    extent = np.asarray(size)
    corners = []
    while len(corners) < boxes:
        edge = rng.uniform([0.2, 0.2, 0.2], [0.9, 0.9, 1.8])
        low = rng.uniform(0.0, extent - edge)
        low[2] = 0.0 if rng.random() < 0.7 else low[2]
        corners.append(np.stack([low, low + edge]))
    return Room(extent, np.stack(corners))


def tof_directions() -> FloatArray:
    """Unit ray directions (41616, 3) in the rig frame (X forward, Y left, Z up)."""
    focal = 0.5 * SIZE_PX / np.tan(HALF_FIELD_OF_VIEW)
    c = (np.arange(SIZE_PX) - 0.5 * (SIZE_PX - 1)) / focal
    v, u = np.meshgrid(c, c, indexing="ij")
    rays = np.stack([np.ones_like(u), -u, -v], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def tof_scan(room: Room, T_room_rig: FloatArray, rng: np.random.Generator | None, sigma: float = 0.003) -> FloatArray:
    """Points (41616, 3) m in the rig frame; noise along the ray of ``sigma`` m at 2 m, growing with range squared."""
    rays = tof_directions()
    ranges = room.ranges(T_room_rig[:3, 3], rays @ T_room_rig[:3, :3].T)
    if rng is not None:
        ranges = ranges + rng.normal(size=len(ranges)) * sigma * (ranges / 2.0) ** 2
    return rays * ranges[:, None]


def pose(
    x: float, y: float, z: float = 1.2, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> FloatArray:
    """T_room_rig of a position (m) and angles (deg)."""
    return make_transform(rotation_from_euler(*np.deg2rad([yaw_deg, pitch_deg, roll_deg])), np.array([x, y, z]))
