# SPDX-License-Identifier: Apache-2.0
"""From a floor plan to surfaces: rooms with walls, floors, ceilings and lamps, joined by doorways.

Rooms are axis-aligned rectangles on one floor; a doorway is given by a point between two rooms (or on the wall of
one) and cuts an opening into every wall that passes within ``WALL_GAP`` of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray
from slam_simulation.world.world import Material, Rectangle, World

WALL_GAP = 0.35
"""A doorway opens the walls that are no farther from it than this, m."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class RoomStyle:
    """Materials of a room's shell."""

    wall: Material
    floor: Material
    ceiling: Material = Material("ceiling")


STYLES = {
    "office": RoomStyle(Material("plaster"), Material("carpet")),
    "lab": RoomStyle(Material("plaster", 0.95), Material("linoleum", gloss=0.04)),
    "workshop": RoomStyle(Material("brick", 1.25), Material("concrete", gloss=0.02), Material("concrete", 1.3)),
    "conference": RoomStyle(Material("plaster", 0.9), Material("planks", gloss=0.06)),
    "corridor": RoomStyle(Material("plaster", 0.85), Material("tiles", gloss=0.05)),
    "store": RoomStyle(Material("concrete", 1.3), Material("concrete"), Material("concrete", 1.3)),
}


@dataclass(frozen=True)
class Room:
    """A room: ``x`` and ``y`` its extent (least, greatest) in m, ``clutter`` how densely its walls are furnished.

    ``like``: name of an earlier room of the same size and openings that it looks exactly like.
    """

    name: str
    x: tuple[float, float]
    y: tuple[float, float]
    height: float = 2.7
    style: str = "office"
    clutter: float = 1.0
    like: str = ""

    def __post_init__(self) -> None:
        if self.style not in STYLES:
            raise ValueError(f"room '{self.name}': unknown style '{self.style}', known: {', '.join(STYLES)}")
        if not (self.x[1] - self.x[0] > 0.5 and self.y[1] - self.y[0] > 0.5 and self.height > 1.0):
            raise ValueError(f"room '{self.name}' is too small: x {self.x}, y {self.y}, height {self.height} m")

    def contains(self, x: float, y: float, margin: float = 0.0) -> bool:
        """True if a place lies in the room, or no farther than ``margin`` (m) beside it."""
        inside_x = self.x[0] - margin <= x <= self.x[1] + margin
        return inside_x and self.y[0] - margin <= y <= self.y[1] + margin


@dataclass(frozen=True)
class Doorway:
    """An opening at ``at`` (x, y), ``width`` and ``height`` in m."""

    at: tuple[float, float]
    width: float = 1.0
    height: float = 2.1


@dataclass(frozen=True, eq=False)
class Wall:
    """The inner side of one wall: it starts at ``start`` (x, y), runs along ``along`` (unit) for ``length`` m.

    Seen from inside the room it runs to the right; ``inward`` (unit) points into the room. ``openings`` are intervals
    (from, to, height) along it.
    """

    room: int
    start: FloatArray
    along: FloatArray
    length: float
    height: float
    openings: tuple[tuple[float, float, float], ...]

    @property
    def inward(self) -> FloatArray:
        """Unit normal into the room, (x, y)."""
        return np.array([self.along[1], -self.along[0]])

    def point(self, s: float, z: float = 0.0, out: float = 0.0) -> FloatArray:
        """The place ``s`` m along the wall, ``z`` m up and ``out`` m into the room, (3,)."""
        return np.array([*(self.start + s * self.along + out * self.inward), z])

    def panel(self, s: tuple[float, float], z: tuple[float, float], material: Material, out: float = 0.0) -> Rectangle:
        """A rectangle on the wall over the intervals ``s`` and ``z``, ``out`` m before it."""
        edge_u = np.array([*(self.along * (s[1] - s[0])), 0.0])
        return Rectangle(self.point(s[0], z[0], out), edge_u, UP * (z[1] - z[0]), material, self.room)


def room_walls(index: int, room: Room, doorways: list[Doorway]) -> list[Wall]:
    """The four walls of a room with their openings."""
    (x0, x1), (y0, y1) = room.x, room.y
    sides = [
        ((x0, y1), (1, 0), x1 - x0),
        ((x1, y1), (0, -1), y1 - y0),
        ((x1, y0), (-1, 0), x1 - x0),
        ((x0, y0), (0, 1), y1 - y0),
    ]
    walls = []
    for start, along, length in sides:
        a, s = np.array(along, dtype=np.float64), np.array(start, dtype=np.float64)
        inward = np.array([a[1], -a[0]])
        openings = []
        for door in doorways:
            place = np.array(door.at) - s
            first, last = float(place @ a) - door.width / 2, float(place @ a) + door.width / 2
            if abs(place @ inward) <= WALL_GAP and first > -0.01 and last < length + 0.01:
                openings.append((first, last, door.height))
        walls.append(Wall(index, s, a, length, room.height, tuple(sorted(openings))))
    return walls


def build_shell(world: World, index: int, room: Room, walls: list[Wall]) -> None:
    """Add floor, ceiling, walls, skirting and lamps of a room."""
    style, (x0, x1), (y0, y1) = STYLES[room.style], room.x, room.y
    width, depth = np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
    world.add(Rectangle(np.array([x0, y0, 0.0]), width, depth, style.floor, index))
    world.add(Rectangle(np.array([x0, y1, room.height]), width, -depth, style.ceiling, index))
    for wall in walls:
        _build_wall(world, wall, style.wall)
    _build_lamps(world, index, room)


def _build_wall(world: World, wall: Wall, material: Material) -> None:
    s, skirting = 0.0, Material("wood", 0.6)
    for first, last, height in (*wall.openings, (wall.length, wall.length, 0.0)):
        if first > s + 1e-6:
            world.add(wall.panel((s, first), (0.0, wall.height), material))
            world.add(wall.panel((s, first), (0.0, 0.09), skirting, 0.008))
        if last > first:
            world.add(wall.panel((first, last), (height, wall.height), material))
        s = last


def _build_lamps(world: World, index: int, room: Room) -> None:
    """Tube lamps under the ceiling, one for about 9 m2."""
    (x0, x1), (y0, y1) = room.x, room.y
    nx, ny = (max(1, round((side[1] - side[0]) / 3.0)) for side in (room.x, room.y))
    length, width = min(1.2, 0.6 * (x1 - x0)), 0.25
    for i in range(nx):
        for j in range(ny):
            cx, cy = x0 + (i + 0.5) * (x1 - x0) / nx, y0 + (j + 0.5) * (y1 - y0) / ny
            origin = np.array([cx - length / 2, cy + width / 2, room.height - 0.06])
            edge_u, edge_v = np.array([length, 0, 0]), np.array([0, -width, 0])
            lamp = Rectangle(origin, edge_u, edge_v, Material("metal", 1.8, emission=2.0), index)
            world.add_lamp(lamp, 0.38 * room.height)


def build_doorways(world: World, doorways: list[Doorway], walls: list[Wall]) -> None:
    """Line every doorway: jambs, lintel and threshold across the gap between the walls it opens."""
    for door in doorways:
        place = np.array(door.at)
        opened = [w for w in walls if _opens(w, place)]
        if len(opened) == 1:
            _close(world, opened[0], place, door)
        elif len(opened) >= 2:
            _line(world, opened[0], opened[1], place, door)


def _opens(wall: Wall, place: FloatArray) -> bool:
    s = float((place - wall.start) @ wall.along)
    near = abs((place - wall.start) @ wall.inward) <= WALL_GAP
    return bool(near and any(first <= s <= last for first, last, _ in wall.openings))


def _close(world: World, wall: Wall, place: FloatArray, door: Doorway) -> None:
    """A doorway that leads nowhere is a closed door."""
    s = float((place - wall.start) @ wall.along)
    world.add(wall.panel((s - door.width / 2, s + door.width / 2), (0.0, door.height), Material("door"), 0.0))


def _line(world: World, a: Wall, b: Wall, place: FloatArray, door: Doorway) -> None:
    s, half, frame = float((place - a.start) @ a.along), door.width / 2, Material("plaster", 0.75)
    gap = float(abs((b.start - a.start) @ a.inward))
    outward = np.array([*(-a.inward * gap), 0.0])
    near, far = a.point(s - half), a.point(s + half)
    along, up = far - near, UP * door.height
    world.add(
        Rectangle(near, outward, up, frame, a.room)
        if np.cross(outward, up) @ along > 0
        else Rectangle(near + outward, -outward, up, frame, a.room)
    )
    world.add(
        Rectangle(far, outward, up, frame, a.room)
        if np.cross(outward, up) @ along < 0
        else Rectangle(far + outward, -outward, up, frame, a.room)
    )
    floor = Rectangle(near, along, outward, frame, a.room)
    world.add(floor if floor.normal[2] > 0 else Rectangle(near + outward, along, -outward, frame, a.room))
    lintel = Rectangle(near + up, outward, along, frame, a.room)
    world.add(lintel if lintel.normal[2] < 0 else Rectangle(near + up, along, outward, frame, a.room))
    for wall in (a, b):
        t = float((place - wall.start) @ wall.along)
        _frame(world, wall, (t - half, t + half), door.height)


def _frame(world: World, wall: Wall, s: tuple[float, float], height: float) -> None:
    """Architrave around an opening, on the room's side."""
    paint, width = Material("plaster", 0.75), 0.07
    world.add(wall.panel((s[0] - width, s[0]), (0.0, height), paint, 0.012))
    world.add(wall.panel((s[1], s[1] + width), (0.0, height), paint, 0.012))
    world.add(wall.panel((s[0] - width, s[1] + width), (height, height + width), paint, 0.012))
