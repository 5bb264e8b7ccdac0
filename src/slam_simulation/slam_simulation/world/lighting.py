# SPDX-License-Identifier: Apache-2.0
"""Baked light: irradiance on a grid of every surface from the lamps of its room, with shadows and darker corners.

Each node of the grid sums over a few points of each lamp, ``power cos(at lamp) cos(at node) / distance^2`` where
nothing stands between, and an even sky light that is weakened where neighbouring surfaces hide part of the room.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.types import Float32Array
from slam_simulation.world import world

NODE_SPACING = 0.2
MAX_NODES = 33
LAMP_POINTS = 4
AMBIENT = 0.7
OPEN_DISTANCE = 0.8
"""Surfaces nearer than this (m) weaken the ambient light."""


def bake(
    surfaces: list[world.Rectangle], lamps: list[world.Lamp]
) -> tuple[Float32Array, npt.NDArray[np.int64], FloatArray]:
    """Irradiance of all surfaces, where each one's grid lies in it, and the lamps as points.

    Returns
    -------
    light
        Flat float32: the grids one after the other, row by row (v), nodes at the borders included.
    lookup
        Shape (n, 3): offset, columns, rows.
    lamps
        Shape (m, 5): position, power, room of each lamp's centre, for highlights.
    """
    columns, rows = np.array([_grid(s) for s in surfaces], dtype=np.int64).T
    offsets = np.concatenate([[0], np.cumsum(columns * rows)[:-1]])
    light = np.empty(int((columns * rows).sum()), np.float32)
    rooms = np.array([s.room for s in surfaces])
    directions = _hemisphere()
    for room in np.unique(rooms):
        members = np.flatnonzero(rooms == room)
        blockers = _blockers([surfaces[i] for i in members])
        points = _lamp_points([lamp for lamp in lamps if lamp.surface.room == room])
        for k, i in enumerate(members):
            s = surfaces[i]
            part = light[offsets[i] : offsets[i] + columns[i] * rows[i]]
            shape = (int(columns[i]), int(rows[i]))
            frame = np.array([s.origin, s.edge_u, s.edge_v])
            axes = np.array([s.edge_u / s.size[0], s.edge_v / s.size[1], s.normal])
            _irradiance(part, shape, frame, axes, k, blockers, points, directions)
    centres = [[*_centre(lamp.surface), lamp.power, float(lamp.surface.room)] for lamp in lamps]
    return light, np.column_stack([offsets, columns, rows]), np.array(centres, dtype=np.float64).reshape(-1, 5)


def _grid(surface: world.Rectangle) -> tuple[int, int]:
    """Columns and rows of a surface's light map."""
    columns, rows = (int(np.clip(np.ceil(side / NODE_SPACING) + 1, 2, MAX_NODES)) for side in surface.size)
    return columns, rows


def _centre(surface: world.Rectangle) -> FloatArray:
    return np.asarray(surface.origin + 0.5 * (surface.edge_u + surface.edge_v))


def _lamp_points(lamps: list[world.Lamp]) -> FloatArray:
    """Points that stand for the lamps: position, normal, power each, shape (k, 7)."""
    rows = [
        [*(s.origin + (i + 0.5) / LAMP_POINTS * s.edge_u + 0.5 * s.edge_v), *s.normal, lamp.power / LAMP_POINTS]
        for lamp in lamps
        for s in [lamp.surface]
        for i in range(LAMP_POINTS)
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def _blockers(surfaces: list[world.Rectangle]) -> FloatArray:
    """Rectangles as (n, 12): normal, plane offset, edge_u / |edge_u|^2, its offset, edge_v / |edge_v|^2, its offset."""
    out = np.empty((len(surfaces), 12))
    for row, s in zip(out, surfaces, strict=True):
        for k, axis in enumerate((s.normal, s.edge_u / (s.edge_u @ s.edge_u), s.edge_v / (s.edge_v @ s.edge_v))):
            row[4 * k : 4 * k + 3], row[4 * k + 3] = axis, axis @ s.origin
    return out


def _hemisphere() -> FloatArray:
    """Twelve directions spread over a hemisphere around z, with equal weight under the cosine law, shape (12, 3)."""
    k = np.arange(12)
    radius, angle = np.sqrt((k + 0.5) / 12), k * np.pi * (3 - np.sqrt(5))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])


@njit(cache=True, nogil=True, error_model="numpy")
def _blocked(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, own: int, blockers: FloatArray
) -> bool:  # pragma: no cover - compiled
    """True if the segment from (x, y, z) by (dx, dy, dz) meets a rectangle other than ``own``."""
    for q in range(blockers.shape[0]):
        if q == own:
            continue
        b = blockers[q]
        along = b[0] * dx + b[1] * dy + b[2] * dz
        if abs(along) < 1e-9:
            continue
        t = (b[3] - b[0] * x - b[1] * y - b[2] * z) / along
        if t <= 1e-3 or t >= 0.999:
            continue
        hx, hy, hz = x + t * dx, y + t * dy, z + t * dz
        u = b[4] * hx + b[5] * hy + b[6] * hz - b[7]
        v = b[8] * hx + b[9] * hy + b[10] * hz - b[11]
        if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _direct(
    p: FloatArray, normal: FloatArray, own: int, blockers: FloatArray, lamps: FloatArray
) -> float:  # pragma: no cover - compiled
    """Irradiance at ``p`` from the points of all lamps that see it."""
    total = 0.0
    for k in range(lamps.shape[0]):
        dx, dy, dz = lamps[k, 0] - p[0], lamps[k, 1] - p[1], lamps[k, 2] - p[2]
        distance_sq = max(dx * dx + dy * dy + dz * dz, 0.01)
        inverse = 1.0 / np.sqrt(distance_sq)
        cos_node = (normal[0] * dx + normal[1] * dy + normal[2] * dz) * inverse
        cos_lamp = -(lamps[k, 3] * dx + lamps[k, 4] * dy + lamps[k, 5] * dz) * inverse
        if cos_node <= 0.0 or cos_lamp <= 0.0:
            continue
        if not _blocked(p[0], p[1], p[2], dx, dy, dz, own, blockers):
            total += lamps[k, 6] * cos_node * cos_lamp / distance_sq
    return float(total)


@njit(cache=True, nogil=True, error_model="numpy")
def _openness(
    p: FloatArray, axes: FloatArray, own: int, blockers: FloatArray, directions: FloatArray
) -> float:  # pragma: no cover - compiled
    """Share of the hemisphere around axes[2] in which nothing stands within OPEN_DISTANCE."""
    free = 0
    for k in range(directions.shape[0]):
        a, b, c = OPEN_DISTANCE * directions[k, 0], OPEN_DISTANCE * directions[k, 1], OPEN_DISTANCE * directions[k, 2]
        dx = a * axes[0, 0] + b * axes[1, 0] + c * axes[2, 0]
        dy = a * axes[0, 1] + b * axes[1, 1] + c * axes[2, 1]
        dz = a * axes[0, 2] + b * axes[1, 2] + c * axes[2, 2]
        if not _blocked(p[0], p[1], p[2], dx, dy, dz, own, blockers):
            free += 1
    return float(free / directions.shape[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _irradiance(
    out: Float32Array,
    shape: tuple[int, int],
    frame: FloatArray,
    axes: FloatArray,
    own: int,
    blockers: FloatArray,
    lamps: FloatArray,
    directions: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Fill the grid of one surface.

    ``frame`` = origin, edge_u, edge_v and ``axes`` = unit edges and normal, (3, 3) each.
    """
    columns, rows = shape
    for row in range(rows):
        for column in range(columns):
            # Nodes stay a little inside, where a neighbouring wall does not cut them off.
            fu = min(max(column / (columns - 1), 0.02), 0.98)
            fv = min(max(row / (rows - 1), 0.02), 0.98)
            p = frame[0] + fu * frame[1] + fv * frame[2] + 1e-3 * axes[2]
            sky = AMBIENT * (0.35 + 0.65 * _openness(p, axes, own, blockers, directions))
            out[row * columns + column] = _direct(p, axes[2], own, blockers, lamps) + sky
