# SPDX-License-Identifier: Apache-2.0
"""Surfaces that one pixel sees and where its rays meet them, the same for cameras and ToF sensor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.types import Float32Array
from slam_simulation.rendering.raycaster import nearest

EDGE_RAYS = 4
"""Rays along each side of a pixel at the border of surfaces."""


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def place_on_surface(
    planes: FloatArray, shifts: FloatArray, q: int, x: float, y: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Depth, and (u, v) within the surface, where the ray (x, y, 1) meets row ``q`` of the view."""
    p = planes
    z = 1.0 / (p[q, 0] * x + p[q, 1] * y + p[q, 2])
    u = min(max(z * (p[q, 3] * x + p[q, 4] * y + p[q, 5]) - shifts[q, 0], 0.0), 1.0)
    v = min(max(z * (p[q, 6] * x + p[q, 7] * y + p[q, 8]) - shifts[q, 1], 0.0), 1.0)
    return z, u, v


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def surfaces_of_pixel(
    i: int,
    j: int,
    tile: int,
    rays: Float32Array,
    surface: npt.NDArray[np.int32],
    candidates: npt.NDArray[np.int32],
    counts: npt.NDArray[np.int32],
    planes: FloatArray,
    shifts: FloatArray,
    near: FloatArray,
    parts: FloatArray,
) -> int:  # pragma: no cover - compiled
    """Number of surfaces that share pixel (i, j), by EDGE_RAYS x EDGE_RAYS rays where a neighbour sees another.

    Fills a row of ``parts`` (EDGE_RAYS^2, 4) for each: row of the view, share of the pixel, mean x and mean y of its
    rays.
    """
    parts[0, 0], parts[0, 1], parts[0, 2], parts[0, 3] = surface[i, j], 1.0, rays[i, j, 0], rays[i, j, 1]
    found = 1 if surface[i, j] >= 0 else 0
    if _is_edge(surface, i, j):
        found = _split(i, j, tile, rays, candidates, counts, planes, shifts, near, parts)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _is_edge(surface: npt.NDArray[np.int32], i: int, j: int) -> bool:  # pragma: no cover - compiled
    """True if one of the four neighbours of a pixel sees another surface."""
    q = surface[i, j]
    height, width = surface.shape
    return bool(
        (i > 0 and surface[i - 1, j] != q)
        or (j > 0 and surface[i, j - 1] != q)
        or (i + 1 < height and surface[i + 1, j] != q)
        or (j + 1 < width and surface[i, j + 1] != q)
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _split(
    i: int,
    j: int,
    tile: int,
    rays: Float32Array,
    candidates: npt.NDArray[np.int32],
    counts: npt.NDArray[np.int32],
    planes: FloatArray,
    shifts: FloatArray,
    near: FloatArray,
    parts: FloatArray,
) -> int:  # pragma: no cover - compiled
    """Surfaces of a pixel and their shares; fills ``parts`` as :func:`surfaces_of_pixel` tells."""
    found = 0
    for k in range(EDGE_RAYS * EDGE_RAYS):
        s, t = (k // EDGE_RAYS + 0.5) / EDGE_RAYS - 0.5, (k % EDGE_RAYS + 0.5) / EDGE_RAYS - 0.5
        x = rays[i, j, 0] + s * rays[i, j, 2] + t * rays[i, j, 4]
        y = rays[i, j, 1] + s * rays[i, j, 3] + t * rays[i, j, 5]
        q, _, _, _ = nearest(x, y, candidates, counts[tile], tile, planes, shifts, near)
        if q < 0:
            continue
        m = 0
        while m < found and parts[m, 0] != q:
            m += 1
        if m == found:
            parts[m, 0] = q
            parts[m, 1] = parts[m, 2] = parts[m, 3] = 0.0
            found += 1
        parts[m, 1] += 1.0
        parts[m, 2] += x
        parts[m, 3] += y
    for m in range(found):
        parts[m, 2] /= parts[m, 1]
        parts[m, 3] /= parts[m, 1]
        parts[m, 1] /= EDGE_RAYS * EDGE_RAYS
    return found
