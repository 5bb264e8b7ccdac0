# SPDX-License-Identifier: Apache-2.0
"""Moving things: people who walk through the view or ahead of the rig, and a chair that somebody moves.

Moving things are the last surfaces of the world, drawn where they stand at first; :class:`MovingThings` takes them to
where they are at a time. Light is baked once, so a thing keeps the light, and its soft shadow, of its first place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, make_transform, rotation_from_euler
from slam_simulation.trajectory import Path
from slam_simulation.world.building import Room
from slam_simulation.world.furniture import SIDE, Spot, chair
from slam_simulation.world.surface_table import SurfaceTable
from slam_simulation.world.world import Material, World

_EVERY_S, _SPEED, _AHEAD_M = 12.0, 1.2, 1.8
"""A person crosses the view so often (s), so fast (m/s), so far ahead of where the rig is then (m)."""
_LEAD_S, _LEAD_M, _SWAY_M, _SWAY_HZ = 1.0, 1.2, 0.3, 0.13
"""A companion walks so far (m) ahead of the rig, where it looks so much later (s), and to and fro across its way."""
_CHAIR_AT = (0.3, 0.5)
"""Shares of the recording: where on the rig's way the chair stands, and when it is moved."""
_CHAIR_SHIFT = np.array([0.5, 0.3, 0.0])


@dataclass(frozen=True)
class MovingConfig(Config):
    """Numbers of moving things."""

    people: int = parameter(0, "people who walk through the view", minimum=0, maximum=5)
    companions: int = parameter(0, "people who walk ahead of the rig at its own pace", minimum=0, maximum=2)
    moved_chairs: int = parameter(0, "chairs that are moved halfway through", minimum=0, maximum=5)


def add_moving(world: World, config: MovingConfig, path: Path, rooms: tuple[Room, ...]) -> None:
    """Add the moving things to a world, as its last surfaces, where they are at the start."""
    things = MovingThings(config, path)
    for k in range(config.people):
        _person(world, _spot(rooms, things.person(k, 0.0)))
    for k in range(config.companions):
        _person(world, _spot(rooms, things.companion(k, 0.0)))
    for k in range(config.moved_chairs):
        chair(world, _spot(rooms, things.chair(k, 0.0)))


class MovingThings:
    """Places of the moving things at a time; they keep to the way of a rig."""

    def __init__(self, config: MovingConfig, path: Path) -> None:
        self._config = config
        self._path = path

    def at(self, table: SurfaceTable, t: float) -> SurfaceTable:
        """The world at time ``t`` s."""
        c = self._config
        motions = [(self.person(k, 0.0), self.person(k, t), _PERSON_SURFACES) for k in range(c.people)]
        motions += [(self.companion(k, 0.0), self.companion(k, t), _PERSON_SURFACES) for k in range(c.companions)]
        motions += [(self.chair(k, 0.0), self.chair(k, t), _CHAIR_SURFACES) for k in range(c.moved_chairs)]
        first = len(table.origin) - sum(number for *_, number in motions)
        parts = [np.array(part) for part in (table.origin, table.edge_u, table.edge_v, table.normal)]
        for start, now, number in motions:
            rows = slice(first, first + number)
            T = now @ np.linalg.inv(start)
            parts[0][rows] = parts[0][rows] @ T[:3, :3].T + T[:3, 3]
            for directions in parts[1:]:
                directions[rows] = directions[rows] @ T[:3, :3].T
            first += number
        return table._replace(origin=parts[0], edge_u=parts[1], edge_v=parts[2], normal=parts[3]) if motions else table

    def person(self, k: int, t: float) -> FloatArray:
        """Pose (4, 4) of a person's feet at time ``t`` s, x ahead of the rig; now from one side, now from the other."""
        first = (0.4 + 0.37 * k) * _EVERY_S
        number = round((t - first) / _EVERY_S)
        crossing = first + number * _EVERY_S
        aside = (-1) ** (number + k) * _SPEED * (t - crossing)
        return self._beside_the_way(crossing, aside, _AHEAD_M)

    def companion(self, k: int, t: float) -> FloatArray:
        """Pose (4, 4) of the feet of somebody who walks ahead of the rig, at time ``t`` s."""
        T = self._beside_the_way(t + _LEAD_S, 0.0)
        aside = _SWAY_M * np.sin(2.0 * np.pi * _SWAY_HZ * t + k) + 0.6 * k
        T[:2, 3] = self._path.pose(min(t, self._path.duration))[:2, 3] + T[:2, :2] @ [_LEAD_M, aside]
        return T

    def chair(self, k: int, t: float) -> FloatArray:
        """Pose (4, 4) of a chair at time ``t`` s."""
        where, moved_at = (share * self._path.duration for share in _CHAIR_AT)
        T = self._beside_the_way(where * (1 + k), 0.9)
        if t > moved_at:
            T = T @ make_transform(rotation_from_euler(1.2), _CHAIR_SHIFT)
        return T

    def _beside_the_way(self, t: float, aside: float, ahead: float = 0.0) -> FloatArray:
        T = self._path.pose(min(max(t, 0.0), self._path.duration))
        heading = np.arctan2(T[1, 0], T[0, 0])
        R = rotation_from_euler(float(heading))
        return make_transform(R, np.array([T[0, 3], T[1, 3], 0.0]) + R @ [ahead, aside, 0.0])


def _person(world: World, spot: Spot) -> None:
    """Someone of 1.75 m, of four boxes."""
    trousers, shirt = {SIDE: Material("fabric", 0.7)}, {SIDE: Material("fabric", 1.5)}
    skin = {SIDE: Material("plaster", 0.7)}
    for y in (-0.1, 0.1):
        world.add(*spot.box((0, y, 0), (0.15, 0.14, 0.85), trousers))
    world.add(*spot.box((0, 0, 0.85), (0.24, 0.42, 0.6), shirt))
    world.add(*spot.box((0, 0, 1.5), (0.2, 0.16, 0.25), skin))


def _spot(rooms: tuple[Room, ...], T: FloatArray) -> Spot:
    room = next((k for k, room in enumerate(rooms) if room.contains(T[0, 3], T[1, 3])), 0)
    return Spot(room, T[:3, 3].copy(), float(np.arctan2(T[1, 0], T[0, 0])))


_FACES = 6
_PERSON_SURFACES, _CHAIR_SURFACES = 4 * _FACES, 6 * _FACES
