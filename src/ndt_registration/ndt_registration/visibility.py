"""What a scan says about the space along its rays: surface, free space in front of it, nothing known behind or beside.

A scan that sees only part of a room fits its neighbour best, point for point, where the two overlap most, which is not where
they belong. Free space decides: a point of one scan may lie outside the other's view or hidden behind its surfaces, at a
small price, but not in space the other has looked through.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray


class RangeImage(NamedTuple):
    """Nearest and farthest range (size * size,) m by direction, in the octahedral map (Meyer et al. 2010); 0 where unseen."""

    size: int
    near: FloatArray
    far: FloatArray


class Prices(NamedTuple):
    """Cost of a point that lies outside the view, behind the surface, and in front of it, in free space."""

    unseen: float
    hidden: float
    free: float


@njit(cache=True, nogil=True, inline="always")
def _bin(x: float, y: float, z: float, size: int) -> int:
    s = abs(x) + abs(y) + abs(z)
    if s == 0.0:
        return 0
    u, v = x / s, y / s
    if z < 0.0:
        u, v = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0), (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
    i = min(int((u + 1.0) * 0.5 * size), size - 1)
    j = min(int((v + 1.0) * 0.5 * size), size - 1)
    return i * size + j


@njit(cache=True, nogil=True)
def range_image(points: FloatArray, size: int) -> RangeImage:
    """Range image of points (n, 3) seen from the origin."""
    near, far = np.zeros(size * size), np.zeros(size * size)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        k = _bin(x, y, z, size)
        r = np.sqrt(x * x + y * y + z * z)
        far[k] = max(far[k], r)
        near[k] = r if near[k] == 0.0 else min(near[k], r)
    return RangeImage(size, near, far)


@njit(cache=True, nogil=True)
def visibility_cost(points: FloatArray, t: FloatArray, image: RangeImage, tolerance: float, prices: Prices) -> float:
    """Mean cost of points (n, 3), moved by ``t`` (3,); deviations grow from 0 to the full price between 1 and 2 tolerances."""
    cost = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] + t[0], points[i, 1] + t[1], points[i, 2] + t[2]
        k = _bin(x, y, z, image.size)
        far = image.far[k]
        if far == 0.0:
            cost += prices.unseen
            continue
        r = np.sqrt(x * x + y * y + z * z)
        if r > far + tolerance:
            cost += prices.hidden * min((r - far) / tolerance - 1.0, 1.0)
        elif r < image.near[k] - tolerance:
            cost += prices.free * min((image.near[k] - r) / tolerance - 1.0, 1.0)
    return cost / points.shape[0]


@njit(cache=True, nogil=True)
def lattice_costs(
    points: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
    image: RangeImage,
    tolerance: float,
    prices: Prices,
) -> FloatArray:
    """Cost (k, l) of points (n, 3) at every pair of rotations (k, 3, 3) and translations (l, 3)."""
    costs = np.empty((rotations.shape[0], translations.shape[0]))
    for a in range(rotations.shape[0]):
        turned = points @ rotations[a].T
        for b in range(translations.shape[0]):
            costs[a, b] = visibility_cost(turned, translations[b], image, tolerance, prices)
    return costs
