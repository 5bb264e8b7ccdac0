# SPDX-License-Identifier: Apache-2.0
"""A dense map of nearness to a scan's surfaces, and the cost of many poses at once: the first, cheap look at a pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.clouds.visibility import Prices, RangeImage, direction_bin
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place


class NearField(NamedTuple):
    """Nearness (n, n, n), from 0 to ``FULL``, around the origin.

    In voxels of ``edge`` m of the cube of half-edge ``reach`` m. ``words``: the same memory, four voxels a number.
    """

    values: npt.NDArray[np.uint8]
    words: npt.NDArray[np.int32]
    edge: float
    reach: float


FULL = 6
"""Nearness of a voxel with a point; its neighbours lose one for each axis in which they differ."""


@njit(cache=True, nogil=True)
def near_field(points: FloatArray, edge: float, reach: float) -> NearField:
    """Nearness to points (n, 3); those beyond the cube are left out."""
    n = int(2.0 * reach / edge) + 3
    words = np.zeros((n * n * n + 3) // 4, np.int32)
    values = words.view(np.uint8)[: n * n * n].reshape((n, n, n))
    for p in range(points.shape[0]):
        i = int(np.floor((points[p, 0] + reach) / edge)) + 1
        j = int(np.floor((points[p, 1] + reach) / edge)) + 1
        k = int(np.floor((points[p, 2] + reach) / edge)) + 1
        if min(i, j, k) < 1 or max(i, j, k) >= n - 1 or values[i, j, k] == FULL:
            continue
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    near = np.uint8(FULL - abs(a) - abs(b) - abs(c))
                    values[i + a, j + b, k + c] = max(values[i + a, j + b, k + c], near)
    return NearField(values, words, edge, reach)


# No branch and no byte alone in the loop: so the compiler takes four or eight points at once.
@in_place(fastmath={"reassoc"}, error_model="numpy")
def pose_cost(
    points: FloatArray,
    t: FloatArray,
    image: RangeImage,
    tolerance: float,
    prices: Prices,
    field: NearField,
    gain: float,
) -> float:
    """Mean visibility cost of points (3, n) moved by ``t`` (3,), less ``gain`` times their mean nearness (0 to 1)."""
    xs, ys, zs, far, nearest, words = points[0], points[1], points[2], image.far, image.near, field.words
    size, n = np.int32(image.size), np.int32(field.values.shape[0])
    unseen, hidden, free = prices.unseen, prices.hidden, prices.free
    inverse_edge, inverse_tolerance = 1.0 / field.edge, 1.0 / tolerance
    cost, near = 0.0, np.int32(0)
    for i in range(points.shape[1]):
        x, y, z = xs[i] + t[0], ys[i] + t[1], zs[i] + t[2]
        k = direction_bin(x, y, z, size)
        r = np.sqrt(x * x + y * y + z * z)
        behind = hidden * min((r - far[k]) * inverse_tolerance - 1.0, 1.0)
        before = free * min((nearest[k] - r) * inverse_tolerance - 1.0, 1.0)
        seen = (behind if r > far[k] + tolerance else 0.0) + (before if r < nearest[k] - tolerance else 0.0)
        cost += unseen if far[k] == 0.0 else seen
        a = np.int32(np.floor((x + field.reach) * inverse_edge)) + np.int32(1)
        b = np.int32(np.floor((y + field.reach) * inverse_edge)) + np.int32(1)
        c = np.int32(np.floor((z + field.reach) * inverse_edge)) + np.int32(1)
        inside = (a >= 0) & (b >= 0) & (c >= 0) & (a < n) & (b < n) & (c < n)
        voxel = (a * n + b) * n + c if inside else np.int32(0)
        value = (words[voxel >> np.int32(2)] >> (np.int32(8) * (voxel & np.int32(3)))) & np.int32(15)
        near += value if inside else np.int32(0)
    return float((cost - gain / FULL * near) / points.shape[1])


@njit(cache=True, nogil=True)
def lattice_costs(
    points: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
    image: RangeImage,
    tolerance: float,
    prices: Prices,
    field: NearField,
    gain: float,
) -> FloatArray:
    """:func:`pose_cost` (k, l) of points (n, 3) at every pair of rotations (k, 3, 3) and translations (l, 3)."""
    costs = np.empty((rotations.shape[0], translations.shape[0]))
    for a in range(rotations.shape[0]):
        turned = rotations[a] @ points.T
        for b in range(translations.shape[0]):
            costs[a, b] = pose_cost(turned, translations[b], image, tolerance, prices, field, gain)
    return costs
