# SPDX-License-Identifier: Apache-2.0
"""A world of textured rectangles: what the ray caster draws.

A surface is a rectangle given by a corner and two orthogonal edges; it is seen from the side to which ``edge_u x
edge_v`` points. Boxes are six of them. Everything else (rooms, doors, furniture) is built from these two.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from slam_core.geometry import FloatArray, rotation_from_euler


@dataclass(frozen=True)
class Material:
    """Appearance of a surface.

    ``name`` is a pattern (repeats every few decimetres) or a picture (fills the surface); ``brightness`` multiplies its
    reflectance. ``gloss`` is the strength of the mirror-like part, ``infrared`` the reflectance at the ToF camera's
    850 nm relative to the visible one, ``emission`` the radiance a lamp or a window adds.
    """

    name: str
    brightness: float = 1.0
    gloss: float = 0.0
    infrared: float = 1.0
    emission: float = 0.0


@dataclass(frozen=True, eq=False)
class Rectangle:
    """One rectangle: ``origin`` (3,) m, ``edge_u``, ``edge_v`` (3,) m, orthogonal.

    ``room`` for the light it receives. ``looks_like``: number of the surface whose texture it has too, -1 for its own.
    """

    origin: FloatArray
    edge_u: FloatArray
    edge_v: FloatArray
    material: Material
    room: int = 0
    looks_like: int = -1

    def __post_init__(self) -> None:
        for name in ("origin", "edge_u", "edge_v"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        return float(np.linalg.norm(self.edge_u)), float(np.linalg.norm(self.edge_v))

    @property
    def normal(self) -> FloatArray:
        """Unit normal towards the visible side."""
        n = np.cross(self.edge_u, self.edge_v)
        return np.asarray(n / np.linalg.norm(n))


@dataclass(frozen=True, eq=False)
class Lamp:
    """A rectangle that gives light to its room: a surface and its ``power`` (radiance times area, relative)."""

    surface: Rectangle
    power: float


def box(
    centre: FloatArray, size: FloatArray, faces: dict[str, Material], room: int, yaw: float = 0.0
) -> list[Rectangle]:
    """Surfaces of a box standing at ``centre`` (of its bottom), ``size`` (x, y, z) m, turned by ``yaw`` rad.

    ``faces`` maps front (+x), back, left (+y), right, top to materials; "side" is the default of all, and the bottom is
    drawn with it too.
    """
    x, y, z = np.asarray(size) / [2.0, 2.0, 1.0]
    R = rotation_from_euler(yaw)
    corners = {
        "front": ([x, -y, 0], [0, 2 * y, 0], [0, 0, z]),
        "back": ([-x, y, 0], [0, -2 * y, 0], [0, 0, z]),
        "left": ([x, y, 0], [-2 * x, 0, 0], [0, 0, z]),
        "right": ([-x, -y, 0], [2 * x, 0, 0], [0, 0, z]),
        "top": ([-x, -y, z], [2 * x, 0, 0], [0, 2 * y, 0]),
        "bottom": ([-x, y, 0], [2 * x, 0, 0], [0, -2 * y, 0]),
    }
    return [
        Rectangle(R @ np.array(o) + centre, R @ np.array(u), R @ np.array(v), faces.get(name, faces["side"]), room)
        for name, (o, u, v) in corners.items()
    ]


@dataclass
class World:
    """Surfaces and lamps, and the seed of their textures."""

    seed: int
    surfaces: list[Rectangle] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)

    def add(self, *surfaces: Rectangle) -> None:
        """Add surfaces."""
        self.surfaces.extend(surfaces)

    def add_lamp(self, surface: Rectangle, power: float) -> None:
        """Add a surface that shines."""
        lit = replace(surface, material=replace(surface.material, emission=max(surface.material.emission, 1.0)))
        self.surfaces.append(lit)
        self.lamps.append(Lamp(lit, power))
