# SPDX-License-Identifier: Apache-2.0
"""A dense map of nearness to a scan's surfaces, and the cost of many poses at once: the first, cheap look at a pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.visibility import Prices, RangeImage, point_cost
from slam_core.geometry import FloatArray
from slam_core.in_place import in_place


class NearField(NamedTuple):
    """Nearness (n, n, n), from 0 to ``FULL``, around the origin.

    In voxels of ``edge`` m of the cube of half-edge ``reach`` m.
    """

    values: npt.NDArray[np.uint8]
    edge: float
    reach: float


FULL = 6
"""Nearness of a voxel with a point; its neighbours lose one for each axis in which they differ."""


@njit(cache=True, nogil=True)
def near_field(points: FloatArray, edge: float, reach: float) -> NearField:
    """Nearness to points (n, 3); those beyond the cube are left out."""
    n = int(2.0 * reach / edge) + 3
    values = np.zeros((n, n, n), np.uint8)
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
    return NearField(values, edge, reach)


@in_place()
def pose_cost(
    points: FloatArray,
    t: FloatArray,
    image: RangeImage,
    tolerance: float,
    point_costs: Prices,
    field: NearField,
    gain: float,
) -> float:
    """Mean visibility cost of points (n, 3) moved by ``t`` (3,), less ``gain`` times their mean nearness (0 to 1)."""
    n = field.values.shape[0]
    cost, near = 0.0, 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] + t[0], points[i, 1] + t[1], points[i, 2] + t[2]
        cost += point_cost(x, y, z, image, tolerance, point_costs)[0]
        a = int(np.floor((x + field.reach) / field.edge)) + 1
        b = int(np.floor((y + field.reach) / field.edge)) + 1
        c = int(np.floor((z + field.reach) / field.edge)) + 1
        if min(a, b, c) >= 0 and max(a, b, c) < n:
            near += field.values[a, b, c]
    return float((cost - gain / FULL * near) / points.shape[0])


@njit(cache=True, nogil=True)
def lattice_costs(
    points: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
    image: RangeImage,
    tolerance: float,
    point_costs: Prices,
    field: NearField,
    gain: float,
) -> FloatArray:
    """:func:`pose_cost` (k, l) of points (n, 3) at every pair of rotations (k, 3, 3) and translations (l, 3)."""
    costs = np.empty((rotations.shape[0], translations.shape[0]))
    for a in range(rotations.shape[0]):
        turned = points @ rotations[a].T
        for b in range(translations.shape[0]):
            costs[a, b] = pose_cost(turned, translations[b], image, tolerance, point_costs, field, gain)
    return costs
