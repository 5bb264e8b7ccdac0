# SPDX-License-Identifier: Apache-2.0
"""Furnishing: what stands along the walls and hangs on them, chosen by the room's style from the world's seed.

Every kind is one function that adds surfaces at a place on a wall, or freely in the room. Objects on walls stand a few
millimetres before them, as in reality.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray
from slam_simulation.world.building import Room, Wall
from slam_simulation.world.world import Material, Rectangle, World, box

Generator = np.random.Generator
_RISE, _SLAB = 0.18, 0.2
"""Height of a step of stairs, and thickness of a gallery's floor, m."""
SIDE = "side"


@dataclass(frozen=True)
class WallItem:
    """A kind of thing at a wall.

    How to build it at ``s`` along the wall, its width (least, greatest) and how deep it is.
    """

    build: Callable[[World, Wall, float, float, Generator], None]
    width: tuple[float, float]
    depth: float


def _hang(kind: str, z: tuple[float, float], height: tuple[float, float], **look: float) -> Callable[..., None]:
    """A builder of pictures that hang with their lower edge at ``z`` and are ``height`` m high."""

    def build(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
        low, tall = float(rng.uniform(*z)), float(rng.uniform(*height))
        top = min(low + tall, wall.height - 0.05)
        out = 0.02 if kind != "window" else 0.003
        material = Material(kind, float(look.get("brightness", 1.0)), look.get("gloss", 0.0), look.get("infrared", 1.0))
        world.add(wall.panel((s, s + width), (low, top), material, out))

    return build


def _window(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    pane = wall.panel(
        (s, s + width), (0.95, min(2.2, wall.height - 0.2)), Material("window", 1.0, 0.05, 0.15, 1.4), 0.003
    )
    world.add_lamp(pane, 1.2 * width)
    world.add(wall.panel((s - 0.05, s + width + 0.05), (0.88, 0.95), Material("wood", 1.3), 0.015))


@dataclass(frozen=True, eq=False)
class Spot:
    """Place of a thing: ``floor`` (3,) m, turned by ``yaw`` rad, in a room. Its x axis is its front."""

    room: int
    floor: FloatArray
    yaw: float

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
        """A point of the thing's own frame in the world, (3,)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(self.floor + np.array([c * x - s * y, s * x + c * y, z]))

    def box(
        self, place: tuple[float, float, float], size: tuple[float, ...], faces: dict[str, Material], turn: float = 0.0
    ) -> list[Rectangle]:
        """A box of ``size`` (x, y, z) m that stands at ``place`` of this frame, turned by ``turn`` rad."""
        return box(self.at(*place), np.array(size), faces, self.room, self.yaw + turn)


def _against(wall: Wall, s: float, width: float, depth: float) -> Spot:
    """The spot of a thing of ``width`` x ``depth`` that stands against the wall, front to the room."""
    return Spot(wall.room, wall.point(s + width / 2, 0.0, depth / 2 + 0.02), float(np.arctan2(*wall.inward[::-1])))


def _pictures_above(world: World, wall: Wall, s: float, width: float, low: float, rng: Generator) -> None:
    """Small pictures and notices over a piece of furniture that is ``low`` m high."""
    at = s + float(rng.uniform(0.0, 0.15))
    while at < s + width - 0.25:
        wide, bottom = float(rng.uniform(0.2, 0.5)), low + float(rng.uniform(0.15, 0.4))
        top = min(bottom + wide * float(rng.uniform(0.9, 1.5)), wall.height - 0.1)
        if top > bottom + 0.15 and rng.random() < 0.75:
            kind = str(rng.choice(["poster", "poster", "label", "notices"]))
            world.add(wall.panel((at, min(at + wide, s + width)), (bottom, top), Material(kind), 0.012))
        at += wide + float(rng.uniform(0.05, 0.3))


def _cupboard(front: str, side: str, depth: float, height: tuple[float, float]) -> Callable[..., None]:
    """A builder of boxes with a picture in front."""

    def build(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
        spot, tall = _against(wall, s, width, depth), float(rng.uniform(*height))
        faces = {"front": Material(front), SIDE: Material(side, float(rng.uniform(0.7, 1.2)))}
        world.add(*spot.box((0, 0, 0), (depth, width, tall), faces))
        if tall < 1.5:
            _things(world, spot, tall, (depth, width), rng)
            _pictures_above(world, wall, s, width, tall + 0.3, rng)

    return build


def _things(world: World, spot: Spot, z: float, area: tuple[float, float], rng: Generator) -> None:
    """A few small boxes on a top of ``area`` (deep, wide) m at height ``z``."""
    for place in np.linspace(-0.35, 0.35, int(rng.integers(1, 4))):
        size = tuple(rng.uniform([0.08, 0.1, 0.08], [0.25, 0.3, 0.35]))
        x, y = rng.uniform(-0.15, 0.1) * area[0], (place + rng.uniform(-0.05, 0.05)) * area[1]
        faces = {"front": Material(str(rng.choice(["label", "panel", "poster"]))), SIDE: Material("cardboard")}
        world.add(*spot.box((float(x), float(y), z), size, faces, float(rng.normal(0, 0.2))))


def _desk(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    depth, height = 0.7, 0.74
    spot, wood = _against(wall, s, width, depth), Material("wood", float(rng.uniform(0.8, 1.3)))
    world.add(*spot.box((0, 0, height - 0.03), (depth, width, 0.03), {"top": Material("desktop"), SIDE: wood}))
    for side in (-0.5, 0.5):
        world.add(*spot.box((0, side * (width - 0.06), 0), (depth - 0.1, 0.03, height - 0.03), {SIDE: wood}))
    screen = {"front": Material("screen", 1.0, 0.1, 0.4), SIDE: Material("fabric", 0.4)}
    place = (-0.12, float(rng.uniform(-0.2, 0.2)) * width, height)
    world.add(*spot.box(place, (0.06, 0.5, 0.38), screen, float(rng.normal(0, 0.15))))
    _things(world, spot, height, (depth, width), rng)
    _pictures_above(world, wall, s, width, height + 0.4, rng)
    seat = spot.at(0.6, float(rng.uniform(-0.2, 0.2)))
    chair(world, Spot(wall.room, seat, spot.yaw + float(rng.normal(3.1, 0.5))))


def _cartons(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    spot, z = _against(wall, s, width, 0.5), 0.0
    faces = {"front": Material("label"), "left": Material("label"), SIDE: Material("cardboard")}
    for _ in range(int(rng.integers(1, 4))):
        size = tuple(rng.uniform([0.3, 0.3, 0.2], [0.45, max(0.35, 0.9 * width), 0.4]))
        world.add(*spot.box((0, 0, z), size, faces, float(rng.normal(0, 0.1))))
        z += float(size[2])
    _pictures_above(world, wall, s, width, z + 0.1, rng)


def _radiator(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    for k in range(int(width / 0.1)):
        spot = _against(wall, s + 0.1 * k, 0.07, 0.1)
        world.add(*spot.box((0, 0, 0.12), (0.1, 0.07, 0.6), {SIDE: Material("plaster")}))


def chair(world: World, spot: Spot) -> None:
    """A chair of six boxes; its back is at -x of its own frame."""
    fabric, steel = {SIDE: Material("fabric", 1.4)}, {SIDE: Material("metal", 0.6)}
    world.add(*spot.box((0, 0, 0.42), (0.44, 0.44, 0.06), fabric))
    world.add(*spot.box((-0.2, 0, 0.55), (0.05, 0.42, 0.4), fabric))
    for x in (-0.19, 0.19):
        for y in (-0.19, 0.19):
            world.add(*spot.box((x, y, 0), (0.03, 0.03, 0.42), steel))


def table(world: World, spot: Spot, size: tuple[float, float], rng: Generator) -> None:
    """A table of ``size`` (x, y) m with things on it."""
    world.add(*spot.box((0, 0, 0.71), (*size, 0.035), {"top": Material("desktop"), SIDE: Material("wood")}))
    for x in (-0.45, 0.45):
        for y in (-0.42, 0.42):
            world.add(*spot.box((x * size[0], y * size[1], 0), (0.06, 0.06, 0.71), {SIDE: Material("metal")}))
    for along in np.arange(-0.4, 0.41, 0.4 / max(size[0], 0.4)):
        middle = Spot(spot.room, spot.at(float(along) * size[0]), spot.yaw)
        _things(world, middle, 0.745, (0.4, size[1]), rng)


def pillar(world: World, spot: Spot, height: float, side: float = 0.4) -> None:
    """A square pillar with a notice on two of its sides."""
    faces = {"front": Material("poster"), "left": Material("notices"), SIDE: Material("concrete", 1.3)}
    world.add(*spot.box((0, 0, 0), (side, side, height), faces))


def stairs(world: World, spot: Spot, size: tuple[float, float], height: float) -> None:
    """Solid stairs of ``size`` (x, y) m up to a height, which rise along x of their own frame."""
    steps = round(height / _RISE)
    tread = size[0] / steps
    faces = {"top": Material("planks", 0.9), SIDE: Material("concrete", 1.1)}
    for k in range(steps):
        x = (k + 0.5) * tread - size[0] / 2.0
        world.add(*spot.box((x, 0, 0), (tread, size[1], (k + 1) * height / steps), faces))


def gallery(world: World, spot: Spot, size: tuple[float, float], height: float) -> None:
    """A floor of ``size`` (x, y) m whose upper side is at a height."""
    faces = {"top": Material("tiles"), SIDE: Material("concrete", 1.2)}
    world.add(*spot.box((0, 0, height - _SLAB), (*size, _SLAB), faces))


def _pictures(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    _pictures_above(world, wall, s, width, 0.8, rng)


ITEMS: dict[str, WallItem] = {
    "poster": WallItem(_hang("poster", (0.9, 1.4), (0.6, 1.0)), (0.45, 0.9), 0.03),
    "pictures": WallItem(_pictures, (0.5, 1.2), 0.03),
    "notices": WallItem(_hang("notices", (1.0, 1.2), (0.8, 1.0)), (0.9, 1.4), 0.03),
    "whiteboard": WallItem(_hang("whiteboard", (0.9, 1.0), (1.0, 1.2), gloss=0.5), (1.5, 2.2), 0.03),
    "pegboard": WallItem(_hang("pegboard", (0.9, 1.1), (0.8, 1.1)), (1.0, 1.8), 0.03),
    "window": WallItem(_window, (1.0, 1.6), 0.03),
    "bookshelf": WallItem(_cupboard("bookshelf", "wood", 0.3, (1.8, 2.1)), (0.8, 1.2), 0.35),
    "cabinet": WallItem(_cupboard("cabinet", "metal", 0.45, (0.9, 1.9)), (0.8, 1.1), 0.5),
    "machine": WallItem(_cupboard("panel", "metal", 0.6, (0.9, 1.8)), (0.7, 1.2), 0.65),
    "desk": WallItem(_desk, (1.3, 1.7), 1.1),
    "cartons": WallItem(_cartons, (0.5, 0.7), 0.6),
    "radiator": WallItem(_radiator, (0.8, 1.2), 0.15),
}

CONTENTS: dict[str, tuple[str, ...]] = {
    "office": ("desk", "poster", "bookshelf", "window", "notices", "cabinet", "pictures", "whiteboard", "poster"),
    "lab": ("desk", "machine", "poster", "cabinet", "whiteboard", "window", "bookshelf", "cartons", "pictures"),
    "workshop": ("machine", "pegboard", "cartons", "pictures", "cabinet", "pegboard", "desk", "notices", "poster"),
    "conference": ("whiteboard", "poster", "pictures", "window", "cabinet", "poster", "radiator", "notices"),
    "corridor": ("poster", "notices", "pictures", "poster", "radiator", "pictures"),
    "store": ("cartons", "cabinet", "cartons", "machine", "bookshelf", "pictures"),
}


def blank(world: World, spot: Spot, size: tuple[float, float]) -> None:
    """A white wall of ``size`` (width, height) m without any texture, seen from the spot's front."""
    width, height = size
    edge_u, edge_v = spot.at(0.0, width) - spot.at(), np.array([0.0, 0.0, height])
    world.add(Rectangle(spot.at(0.0, -0.5 * width), edge_u, edge_v, Material("white"), spot.room))


def furnish_wall(world: World, wall: Wall, room: Room, rng: Generator) -> None:
    """Fill a wall from left to right with the things of the room's style; ``clutter`` scales how close they stand."""
    kinds = list(CONTENTS[room.style])
    rng.shuffle(kinds)
    s = 0.15 + float(rng.uniform(0, 0.3))
    while s < wall.length - 0.3:
        for kind in kinds:
            item, width = ITEMS[kind], float(rng.uniform(*ITEMS[kind].width))
            if _free(wall, s, s + width, item.depth):
                item.build(world, wall, s, width, rng)
                kinds.append(kinds.pop(kinds.index(kind)))
                s += width + float(rng.uniform(0.08, 0.4)) / max(room.clutter, 0.1)
                break
        else:
            s += 0.2
    _fittings(world, wall, rng)


def _fittings(world: World, wall: Wall, rng: Generator) -> None:
    """Sockets near the floor, a cable duct, and a switch beside every opening."""
    plastic = Material("label", 1.2)
    for s in np.arange(0.6 + float(rng.uniform(0, 0.5)), wall.length - 0.3, 1.7):
        if _free(wall, float(s), float(s) + 0.16, 0.02):
            world.add(wall.panel((float(s), float(s) + 0.16), (0.28, 0.36), plastic, 0.01))
    for first, last, _ in wall.openings:
        s = last + 0.15 if last + 0.3 < wall.length else first - 0.25
        if 0.05 < s < wall.length - 0.15:
            world.add(wall.panel((s, s + 0.09), (1.05, 1.2), plastic, 0.01))
    if not wall.openings:
        world.add(wall.panel((0.02, wall.length - 0.02), (0.78, 0.86), Material("metal", 1.3), 0.008))


def _free(wall: Wall, first: float, last: float, depth: float) -> bool:
    """True if an interval of a wall has no opening near it and leaves the corners to the neighbouring walls."""
    corner = 0.1 if depth < 0.1 else 0.7
    if first < corner or last > wall.length - corner:
        return False
    spare = 0.12 if depth < 0.1 else 0.4
    return all(last < a - spare or first > b + spare for a, b, _ in wall.openings)
