# SPDX-License-Identifier: Apache-2.0
"""The world as arrays for the compiled ray caster: geometry, looks, textures and baked light, one row per surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import Float32Array
from slam_simulation.world.atlas import TextureAtlas, TextureTable
from slam_simulation.world.lighting import bake
from slam_simulation.world.materials import PATTERNS
from slam_simulation.world.pictures import PICTURES, draw_picture
from slam_simulation.world.tags import is_tag, tag_picture
from slam_simulation.world.world import Rectangle, World

OVERLAY = "blotches"
OVERLAY_GAIN = 0.35
"""Pattern laid over every repeating pattern, and its contrast."""


class SurfaceTable(NamedTuple):
    """The world as arrays, one row per surface, for the kernels.

    origin, edge_u, edge_v, normal: (n, 3) float64. look: (n, 13) float64, see :class:`Look`. lookup: (n, 6) int64 =
    texture, overlay texture or -1, light map offset, its columns, its rows, room. light: flat float32 irradiance.
    lamps: (m, 5) float64 = position, power, room.
    """

    origin: FloatArray
    edge_u: FloatArray
    edge_v: FloatArray
    normal: FloatArray
    look: FloatArray
    lookup: npt.NDArray[np.int64]
    light: Float32Array
    lamps: FloatArray
    textures: TextureTable


class Look:
    """Columns of ``SurfaceTable.look``."""

    SHIFT_U, SHIFT_V, SCALE_U, SCALE_V = 0, 1, 2, 3
    OVERLAY_U, OVERLAY_V, OVERLAY_SCALE_U, OVERLAY_SCALE_V, OVERLAY_GAIN = 4, 5, 6, 7, 8
    BRIGHTNESS, GLOSS, INFRARED, EMISSION = 9, 10, 11, 12


def compile_world(world: World) -> SurfaceTable:
    """Draw the textures, bake the light and pack everything into arrays."""
    atlas = TextureAtlas()
    surfaces = world.surfaces
    looks, textures = zip(*(_appearance(world.seed, i, s, atlas) for i, s in enumerate(surfaces)), strict=True)
    light, light_lookup, lamps = bake(surfaces, world.lamps)
    rooms = np.array([s.room for s in surfaces])
    return SurfaceTable(
        origin=np.array([s.origin for s in surfaces], dtype=np.float64),
        edge_u=np.array([s.edge_u for s in surfaces], dtype=np.float64),
        edge_v=np.array([s.edge_v for s in surfaces], dtype=np.float64),
        normal=np.array([s.normal for s in surfaces]),
        look=np.array(looks),
        lookup=np.column_stack([np.array(textures), light_lookup, rooms]).astype(np.int64),
        light=light,
        lamps=lamps,
        textures=atlas.table(),
    )


def _appearance(seed: int, i: int, surface: Rectangle, atlas: TextureAtlas) -> tuple[list[float], tuple[int, int]]:
    """Row of ``look`` and the texture numbers of one surface."""
    material, (width, height) = surface.material, surface.size
    i = i if surface.looks_like < 0 else surface.looks_like
    rng = np.random.default_rng([seed, i])
    tail = [material.brightness, material.gloss, material.infrared, material.emission]
    if material.name in PICTURES or is_tag(material.name):
        name = f"{material.name}/{i}"
        if name not in atlas:
            picture = (
                tag_picture(material.name) if is_tag(material.name) else draw_picture(material.name, width, height, rng)
            )
            atlas.add(name, picture, clamp=True)
        texture = atlas[name]
        # Rows of a picture run downwards, edge_v upwards.
        return [0.0, 1.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, *tail], (texture, -1)
    texture, overlay = _pattern(seed, material.name, atlas), _pattern(seed, OVERLAY, atlas)
    near, far = PATTERNS[material.name].extent, PATTERNS[OVERLAY].extent
    shift = rng.random(4)
    scales = [width / near, height / near], [width / far, height / far]
    return [*shift[:2], *scales[0], *shift[2:], *scales[1], OVERLAY_GAIN, *tail], (texture, overlay)


def _pattern(seed: int, name: str, atlas: TextureAtlas) -> int:
    """Number of the texture of a repeating pattern, drawn when it is first asked for."""
    if name not in PATTERNS:
        raise ValueError(f"unknown material '{name}', known: {', '.join([*PATTERNS, *PICTURES])}")
    if name in atlas:
        return atlas[name]
    rng = np.random.default_rng([seed, 10_000_000 + list(PATTERNS).index(name)])
    return atlas.add(name, PATTERNS[name].draw(rng), clamp=False)
