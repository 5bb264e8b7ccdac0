# SPDX-License-Identifier: Apache-2.0
"""Rims of things that stand before a farther background: the features that fix a scan of walls along the walls.

A point is on a rim where, in the direction of view, the surface ends beside it and the view goes on behind. Where the
view itself ends, and where a nearer thing hides what is behind, the surface ends for the viewer only: no rim is found
there (compare the edge features of Zhang and Singh 2014; these need no scan lines).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from ndt_registration.clouds.visibility import MEAN_BIN, direction_bin
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place

Int32Array = npt.NDArray[np.int32]

REACH_SPACINGS = 3.0
"""Distance within which a point looks for what is beside it, in mean angles between neighbouring points."""
MAX_IMAGE_SIZE = 512


@njit(cache=True, nogil=True)
def _sorted_by_bin(points: FloatArray, size: int) -> tuple[FloatArray, FloatArray, Int32Array, Int32Array, FloatArray]:
    """Unit directions (n, 3) and ranges (n,) in the order of their bins.

    Also the bin of each, the first of each bin (size^2 + 1,) and the farthest range of each bin (size^2,).
    """
    n = points.shape[0]
    farthest = np.zeros(size * size)
    bins = np.empty(n, np.int32)
    first = np.zeros(size * size + 1, np.int32)
    for i in range(n):
        bins[i] = direction_bin(points[i, 0], points[i, 1], points[i, 2], size)
        first[bins[i] + 1] += 1
    for k in range(size * size):
        first[k + 1] += first[k]
    place = first.copy()
    directions, ranges, sorted_bins = np.empty((n, 3)), np.empty(n), np.empty(n, np.int32)
    for i in range(n):
        j = place[bins[i]]
        place[bins[i]] += 1
        r = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2)
        ranges[j], sorted_bins[j] = r, bins[i]
        farthest[bins[i]] = max(farthest[bins[i]], r)
        for c in range(3):
            directions[j, c] = points[i, c] / max(r, 1e-12)
    return directions, ranges, sorted_bins, first, farthest


@in_place()
def _nearest_behind(
    i: int, size: int, reach: float, step: float, d: FloatArray, r: FloatArray, bins: Int32Array, first: Int32Array
) -> int:
    """The nearest point beside ``i`` that is more than ``step`` farther away, -1 if none is within reach."""
    row, column = bins[i] // size, bins[i] % size
    best, nearest = -1, reach * reach
    for a in range(max(row - 1, 0), min(row + 2, size)):
        low = a * size + max(column - 1, 0)
        high = a * size + min(column + 1, size - 1)
        for j in range(first[low], first[high + 1]):
            if r[j] > r[i] + step:
                distance = (d[j, 0] - d[i, 0]) ** 2 + (d[j, 1] - d[i, 1]) ** 2 + (d[j, 2] - d[i, 2]) ** 2
                if 0.0 < distance < nearest:
                    best, nearest = j, distance
    return best


@in_place()
def _surface_goes_on(
    i: int, behind: int, size: int, step: float, d: FloatArray, r: FloatArray, bins: Int32Array, first: Int32Array
) -> bool:
    """True if a point of the surface of ``i`` lies farther towards ``behind`` than ``i`` does, or before it."""
    row, column = bins[i] // size, bins[i] % size
    bx, by, bz = d[behind, 0] - d[i, 0], d[behind, 1] - d[i, 1], d[behind, 2] - d[i, 2]
    gap = bx * bx + by * by + bz * bz
    for a in range(max(row - 1, 0), min(row + 2, size)):
        low = a * size + max(column - 1, 0)
        high = a * size + min(column + 1, size - 1)
        for j in range(first[low], first[high + 1]):
            if r[j] <= r[i] + step and j != i:
                x, y, z = d[j, 0] - d[i, 0], d[j, 1] - d[i, 1], d[j, 2] - d[i, 2]
                along = (x * bx + y * by + z * bz) / gap
                across = x * x + y * y + z * z - along * along * gap
                if 0.3 < along < 2.0 and across < gap:
                    return True
    return False


@in_place()
def _farthest_around(k: int, size: int, farthest: FloatArray) -> float:
    """Farthest range in a bin and those beside it."""
    row, column, limit = k // size, k % size, 0.0
    for a in range(max(row - 1, 0), min(row + 2, size)):
        for b in range(max(column - 1, 0), min(column + 2, size)):
            limit = max(limit, farthest[a * size + b])
    return limit


@njit(cache=True, nogil=True)
def _rims(points: FloatArray, size: int, reach: float, step: float) -> FloatArray:
    d, r, bins, first, farthest = _sorted_by_bin(points, size)
    out = np.empty((points.shape[0], 3))
    used = _find_rims(size, reach, step, d, r, bins, first, farthest, out)
    return out[:used].copy()


@in_place()
def _find_rims(
    size: int,
    reach: float,
    step: float,
    d: FloatArray,
    r: FloatArray,
    bins: Int32Array,
    first: Int32Array,
    farthest: FloatArray,
    out: FloatArray,
) -> int:
    """Write the rims to ``out``; returns their number."""
    used, last, limit = 0, -1, 0.0
    for i in range(len(r)):
        if bins[i] != last:
            last, limit = bins[i], _farthest_around(bins[i], size, farthest)
        if not limit > r[i] + step:  # on most surfaces nothing is farther by so much
            continue
        behind = _nearest_behind(i, size, reach, step, d, r, bins, first)
        if behind < 0 or _surface_goes_on(i, behind, size, step, d, r, bins, first):
            continue
        # The rim lies between the last direction that sees the surface and the first that misses it.
        for c in range(3):
            out[used, c] = 0.5 * r[i] * (d[i, c] + d[behind, c])
        used += 1
    return used


def rim_points(points: FloatArray, spacing: float, step: float) -> FloatArray:
    """Points (m, 3) m on rims of a scan (n, 3) seen from the origin.

    Parameters
    ----------
    points
        The scan, m.
    spacing
        Mean angle between neighbouring points, rad.
    step
        Least gap in range at a rim, m.
    """
    reach = REACH_SPACINGS * spacing
    size = int(min(max(MEAN_BIN / reach, 8), MAX_IMAGE_SIZE))
    return np.asarray(_rims(points, size, reach, step))
