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
def _gather_around(k: int, size: int, d: FloatArray, r: FloatArray, first: Int32Array, around: FloatArray) -> int:
    """Write directions and ranges of the points in a bin and those beside it to ``around`` (5, n); how many they are.

    One coordinate beside the other's: so the compiler takes eight points at once.
    """
    row, column, count = k // size, k % size, 0
    for a in range(max(row - 1, 0), min(row + 2, size)):
        low = a * size + max(column - 1, 0)
        high = a * size + min(column + 1, size - 1)
        for j in range(first[low], first[high + 1]):
            around[0, count], around[1, count], around[2, count] = d[j, 0], d[j, 1], d[j, 2]
            around[3, count] = r[j]
            count += 1
    return count


@in_place(fastmath={"nnan", "nsz"})
def _nearest_behind(x, y, z, least, reach, xs, ys, zs, ranges, gaps):  # type: ignore[no-untyped-def]
    """Index of the nearest direction that is more than ``least`` m away, -1 if none is within reach.

    ``gaps`` (n,) is room for the squared distances between directions.
    """
    nearest = reach * reach
    for j in range(xs.shape[0]):
        gap = (xs[j] - x) ** 2 + (ys[j] - y) ** 2 + (zs[j] - z) ** 2
        gaps[j] = gap if (ranges[j] > least) & (gap > 0.0) else np.inf
    for j in range(xs.shape[0]):
        nearest = min(nearest, gaps[j])
    if nearest < reach * reach:
        for j in range(xs.shape[0]):
            if gaps[j] == nearest:
                return j
    return -1


@in_place(error_model="numpy")
def _surface_goes_on(x, y, z, behind, least, xs, ys, zs, ranges):  # type: ignore[no-untyped-def]
    """True if a point of the surface lies farther towards ``behind`` than (x, y, z) does, or before it."""
    bx, by, bz = xs[behind] - x, ys[behind] - y, zs[behind] - z
    gap = bx * bx + by * by + bz * bz
    hits = 0
    for j in range(xs.shape[0]):
        dx, dy, dz = xs[j] - x, ys[j] - y, zs[j] - z
        along = (dx * bx + dy * by + dz * bz) / gap
        across = dx * dx + dy * dy + dz * dz - along * along * gap
        hits += (ranges[j] <= least) & (along > 0.3) & (along < 2.0) & (across < gap)
    return hits > 0


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
    out, around = np.empty((points.shape[0], 3)), np.empty((5, points.shape[0]))
    used = _find_rims(size, reach, step, d, r, bins, first, farthest, around, out)
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
    around: FloatArray,
    out: FloatArray,
) -> int:
    """Write the rims to ``out``; returns their number. ``around`` (5, n) is room."""
    used, last, limit, count = 0, -1, 0.0, 0
    for i in range(len(r)):
        if bins[i] != last:
            last, limit, count = bins[i], _farthest_around(bins[i], size, farthest), 0
        least = r[i] + step
        if not limit > least:  # on most surfaces nothing is farther by so much
            continue
        if count == 0:
            count = _gather_around(last, size, d, r, first, around)
        x, y, z = d[i, 0], d[i, 1], d[i, 2]
        xs, ys, zs, ranges = around[0, :count], around[1, :count], around[2, :count], around[3, :count]
        behind = _nearest_behind(x, y, z, least, reach, xs, ys, zs, ranges, around[4])
        if behind < 0 or _surface_goes_on(x, y, z, behind, least, xs, ys, zs, ranges):
            continue
        # The rim lies between the last direction that sees the surface and the first that misses it.
        out[used, 0] = 0.5 * r[i] * (x + xs[behind])
        out[used, 1] = 0.5 * r[i] * (y + ys[behind])
        out[used, 2] = 0.5 * r[i] * (z + zs[behind])
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
