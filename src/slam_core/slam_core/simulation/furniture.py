"""Furnishing: what stands along the walls and hangs on them, chosen by the room's style from the world's seed.

Every kind is one function that adds surfaces at a place on a wall, or freely in the room. Objects on walls stand a few
millimetres before them, as in reality.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.simulation.building import Room, Wall
from slam_core.simulation.world import Material, World, box

Generator = np.random.Generator
SIDE = "side"


@dataclass(frozen=True)
class WallItem:
    """A kind of thing at a wall: how to build it at ``s`` along the wall, its width (least, greatest) and how deep it is."""

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


def _against(wall: Wall, s: float, width: float, depth: float) -> tuple[FloatArray, float]:
    """Centre on the floor and yaw of a box of ``width`` x ``depth`` that stands against the wall, front to the room."""
    centre = wall.point(s + width / 2, 0.0, depth / 2 + 0.02)
    return centre, float(np.arctan2(wall.inward[1], wall.inward[0]))


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
        centre, yaw = _against(wall, s, width, depth)
        tall = float(rng.uniform(*height))
        faces = {"front": Material(front), SIDE: Material(side, float(rng.uniform(0.7, 1.2)))}
        world.add(*box(centre, np.array([depth, width, tall]), faces, wall.room, yaw))
        if tall < 1.5:
            _things(world, wall.room, centre + [0, 0, tall], yaw, (depth, width), rng)
            _pictures_above(world, wall, s, width, tall + 0.3, rng)

    return build


def _things(world: World, room: int, centre: FloatArray, yaw: float, area: tuple[float, float], rng: Generator) -> None:
    """A few small boxes on a top of ``area`` (deep, wide) m."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for place in np.linspace(-0.35, 0.35, int(rng.integers(1, 4))):
        size = rng.uniform([0.08, 0.1, 0.08], [0.25, 0.3, 0.35])
        offset = turn @ [rng.uniform(-0.15, 0.1) * area[0], (place + rng.uniform(-0.05, 0.05)) * area[1]]
        faces = {"front": Material(str(rng.choice(["label", "panel", "poster"]))), SIDE: Material("cardboard")}
        world.add(*box(centre + [*offset, 0.0], size, faces, room, yaw + float(rng.normal(0, 0.2))))


def _desk(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    depth, height = 0.7, 0.74
    centre, yaw = _against(wall, s, width, depth)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    wood = Material("wood", float(rng.uniform(0.8, 1.3)))
    top = {"top": Material("desktop"), SIDE: wood}
    world.add(*box(centre + [0, 0, height - 0.03], np.array([depth, width, 0.03]), top, wall.room, yaw))
    for side in (-0.5, 0.5):
        leg = centre + [*(turn @ [0.0, side * (width - 0.06)]), 0.0]
        world.add(*box(leg, np.array([depth - 0.1, 0.03, height - 0.03]), {SIDE: wood}, wall.room, yaw))
    screen = {"front": Material("screen", 1.0, 0.1, 0.4), SIDE: Material("fabric", 0.4)}
    at = centre + [*(turn @ [-0.12, rng.uniform(-0.2, 0.2) * width]), height]
    world.add(*box(at, np.array([0.06, 0.5, 0.38]), screen, wall.room, yaw + float(rng.normal(0, 0.15))))
    _things(world, wall.room, centre + [0, 0, height], yaw, (depth, width), rng)
    _pictures_above(world, wall, s, width, height + 0.4, rng)
    chair(world, wall.room, centre + [*(turn @ [0.6, rng.uniform(-0.2, 0.2)]), 0.0], yaw + float(rng.normal(3.1, 0.5)))


def _cartons(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    z = 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform([0.3, 0.3, 0.2], [0.45, max(0.35, 0.9 * width), 0.4])
        centre, yaw = _against(wall, s, width, 0.5)
        faces = {"front": Material("label"), "left": Material("label"), SIDE: Material("cardboard")}
        world.add(*box(centre + [0, 0, z], size, faces, wall.room, yaw + float(rng.normal(0, 0.1))))
        z += float(size[2])
    _pictures_above(world, wall, s, width, z + 0.1, rng)


def _radiator(world: World, wall: Wall, s: float, width: float, rng: Generator) -> None:
    for k in range(int(width / 0.08)):
        centre, yaw = _against(wall, s + 0.08 * k, 0.05, 0.1)
        world.add(*box(centre + [0, 0, 0.12], np.array([0.1, 0.05, 0.6]), {SIDE: Material("plaster")}, wall.room, yaw))


def chair(world: World, room: int, centre: FloatArray, yaw: float) -> None:
    """A chair of six boxes; its back is at -x of its own frame."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    fabric, steel = {SIDE: Material("fabric", 1.4)}, {SIDE: Material("metal", 0.6)}
    world.add(*box(centre + [0, 0, 0.42], np.array([0.44, 0.44, 0.06]), fabric, room, yaw))
    world.add(*box(centre + [*(turn @ [-0.2, 0.0]), 0.55], np.array([0.05, 0.42, 0.4]), fabric, room, yaw))
    for x in (-0.19, 0.19):
        for y in (-0.19, 0.19):
            world.add(*box(centre + [*(turn @ [x, y]), 0.0], np.array([0.03, 0.03, 0.42]), steel, room, yaw))


def table(world: World, room: int, centre: FloatArray, size: tuple[float, float], yaw: float, rng: Generator) -> None:
    """A table of ``size`` (x, y) m with things on it."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    faces = {"top": Material("desktop"), SIDE: Material("wood")}
    world.add(*box(centre + [0, 0, 0.71], np.array([*size, 0.035]), faces, room, yaw))
    for x in (-0.45, 0.45):
        for y in (-0.42, 0.42):
            leg = centre + [*(turn @ [x * size[0], y * size[1]]), 0.0]
            world.add(*box(leg, np.array([0.06, 0.06, 0.71]), {SIDE: Material("metal")}, room, yaw))
    for along in np.arange(-0.4, 0.41, 0.4 / max(size[0], 0.4)):
        _things(world, room, centre + [*(turn @ [along * size[0], 0.0]), 0.745], yaw, (size[1], 0.4), rng)


def pillar(world: World, room: int, centre: FloatArray, height: float, side: float = 0.4) -> None:
    """A square pillar with a notice on two of its sides."""
    faces = {"front": Material("poster"), "left": Material("notices"), SIDE: Material("concrete", 1.3)}
    world.add(*box(centre, np.array([side, side, height]), faces, room))


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
    """Whether an interval of a wall has no opening near it and leaves the corners to the neighbouring walls."""
    corner = 0.1 if depth < 0.1 else 0.7
    if first < corner or last > wall.length - corner:
        return False
    spare = 0.12 if depth < 0.1 else 0.4
    return all(last < a - spare or first > b + spare for a, b, _ in wall.openings)
