# SPDX-License-Identifier: Apache-2.0
"""Space along the rays of a scan: surface, free space in front of it, nothing known behind or beside.

A scan that sees only part of a room fits its neighbour best, point for point, where the two overlap most, which is not
where they belong. Free space decides: a point of one scan may lie outside the other's view or hidden behind its
surfaces, at a small price, but not in space the other has looked through.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place


class RangeImage(NamedTuple):
    """Nearest and farthest range (size * size,) m by direction, in the octahedral map (Meyer et al. 2010).

    0 where unseen.
    """

    size: int
    near: FloatArray
    far: FloatArray


class Prices(NamedTuple):
    """Cost of a point that lies outside the view, behind the surface, and in front of it, in free space."""

    unseen: float
    hidden: float
    free: float


LEAST_MATCH = 0.15
"""Share of the points that must match a surface for a pose to be credible."""
MEAN_BIN = 3.545
"""Mean angle (rad) that a bin of the octahedral map covers, times the size of the map: the root of 4 pi."""


@njit(cache=True, nogil=True, inline="always")
def direction_bin(x, y, z, size):  # type: ignore[no-untyped-def]
    """Bin of a direction, 0 without one; without branches, so that loops over many points vectorise.

    With ``size`` an int32 the bin is one too, of which a vector register holds twice as many.
    """
    total = abs(x) + abs(y) + abs(z)
    s = total if total > 0.0 else 1.0
    u, v = x / s, y / s
    folded_u = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0)
    folded_v = (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
    u, v = (folded_u if z < 0.0 else u), (folded_v if z < 0.0 else v)
    i, j = np.int32((u + 1.0) * 0.5 * size), np.int32((v + 1.0) * 0.5 * size)
    place = min(i, size - np.int32(1)) * size + min(j, size - np.int32(1))
    return place if total > 0.0 else np.int32(0)


@njit(cache=True, nogil=True)
def range_image(points: FloatArray, size: int) -> RangeImage:
    """Range image of points (n, 3) seen from the origin."""
    near, far = np.zeros(size * size), np.zeros(size * size)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        k = direction_bin(x, y, z, size)
        r = np.sqrt(x * x + y * y + z * z)
        far[k] = max(far[k], r)
        near[k] = r if near[k] == 0.0 else min(near[k], r)
    return RangeImage(size, near, far)


@njit(cache=True, nogil=True)
def visibility_cost(points: FloatArray, T: FloatArray, image: RangeImage, tolerance: float, costs: Prices) -> float:
    """Mean cost of points (n, 3), moved by ``T`` (4, 4): from 0 to the full one between 1 and 2 tolerances.

    Where hardly anything matches nothing can be said: below a share ``LEAST_MATCH`` of matches the cost rises towards
    1.
    """
    turned = np.ascontiguousarray(T[:3, :3]) @ points.T
    return float(_mean_cost(turned, T[0, 3], T[1, 3], T[2, 3], image, tolerance, costs))


# No branch: so the compiler takes eight points at once.
@in_place(fastmath={"reassoc"}, error_model="numpy")
def _mean_cost(points, tx, ty, tz, image, tolerance, costs):  # type: ignore[no-untyped-def]
    """:func:`visibility_cost` of points (3, n), moved by (tx, ty, tz)."""
    xs, ys, zs = points[0], points[1], points[2]
    size, near, far, inverse = np.int32(image.size), image.near, image.far, 1.0 / tolerance
    unseen, hidden, free = costs.unseen, costs.hidden, costs.free
    cost, matches = 0.0, 0.0
    for i in range(points.shape[1]):
        x, y, z = xs[i] + tx, ys[i] + ty, zs[i] + tz
        k = direction_bin(x, y, z, size)
        r = np.sqrt(x * x + y * y + z * z)
        is_behind, is_before = r > far[k] + tolerance, r < near[k] - tolerance
        behind = hidden * min((r - far[k]) * inverse - 1.0, 1.0)
        before = free * min((near[k] - r) * inverse - 1.0, 1.0)
        seen = behind if is_behind else (before if is_before else 0.0)
        cost += unseen if far[k] == 0.0 else seen
        matches += 0.0 if (far[k] == 0.0) | is_behind | is_before else 1.0
    share = matches / points.shape[1]
    return float(cost / points.shape[1] + max(1.0 - share / LEAST_MATCH, 0.0))


@in_place()
def mean_spacing(points: FloatArray, image: RangeImage, planar: bool) -> float:
    """Mean angle (rad) between neighbouring points (n, 3), from the part of the sphere, or circle, that they cover."""
    occupied = 0
    for k in range(image.far.shape[0]):
        if image.far[k] > 0.0:
            occupied += 1
    if planar:
        return float(np.pi / image.size * occupied / points.shape[0])
    return float(MEAN_BIN / image.size * np.sqrt(occupied / points.shape[0]))
