# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the descriptor by which the keypoints of a stereo pair are matched with each other.

Its images are neither turned nor enlarged against one another, and the band of rows leaves three candidates for a
keypoint. So upright SURF-128 on 8 x 8 samples, two scale units apart, tells them apart better than the oriented one on
20 x 20 does, in a tenth of its time. Moments are compared by that one: :mod:`stereo_frontend.surf.surf_descriptor`.

Keypoints are described sixteen at a time. Arrays are flat with one number per keypoint innermost, so that the same step
of all sixteen is one loop that the compiler vectorises.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place
from stereo_frontend.surf.surf_descriptor import split_by_sign

LANES = 16
"""Keypoints described at a time."""
SAMPLES = 8
"""Samples along each side."""
STEP = 2.0
"""Scale units from one sample to the next; wavelets are twice as large."""
_CORNERS = SAMPLES + 2
_LINE = _CORNERS * LANES
"""Numbers from one row of corners to the next."""
_REGIONS = 4
"""Subregions along each side."""
_TERMS = 8
"""Numbers per subregion."""
_CELL = _TERMS * LANES
PAIR_DIMENSION = _REGIONS * _REGIONS * _TERMS
WEIGHT_SIGMA = 2.5
"""Width of the Gaussian over the samples, in samples."""


@njit(cache=True, nogil=True)
def describe_for_pair(integral, keypoints, weights, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 128), unit norm, for keypoints (n, 3) of u, v, scale."""
    lattice, columns = np.zeros(_CORNERS * _LINE), (np.empty(_CORNERS, np.intp), np.empty(_CORNERS))
    line, dx, dy = np.empty(_LINE), np.empty(SAMPLES * _LINE, np.float32), np.empty(SAMPLES * _LINE, np.float32)
    terms, rows = np.empty(_CELL, np.float32), np.empty((_REGIONS * SAMPLES, _CELL), np.float32)
    sums, scale = np.empty((_REGIONS * _REGIONS, _CELL), np.float32), np.empty(LANES, np.float32)
    for first in range(0, len(keypoints), LANES):
        count = min(LANES, len(keypoints) - first)
        for k in range(count):
            _read_corners(integral, keypoints[first + k], columns, lattice[k:])
        _haar_wavelets(lattice, line, dx, dy)
        for k in range(count):
            _clear_outside(integral, keypoints[first + k], dx[k:], dy[k:])
        _sum_regions(dx, dy, weights, terms, rows, sums)
        _normalise(sums.reshape(-1), scale, out[first : first + count])


@in_place()
def _read_corners(integral, keypoint, columns, lattice):  # type: ignore[no-untyped-def]
    """Write the integral image, bilinear, at the corners around a keypoint; ``columns`` is room.

    What lies beyond the image's edge is a number without a meaning.
    """
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    left, top, step = _first_corner(keypoint)
    places, shares = columns
    for i in range(_CORNERS):
        x = left + i * step
        places[i] = min(max(int(x), 0), width - 1)
        shares[i] = x - places[i]
    for j in range(_CORNERS):
        y = top + j * step
        y0 = min(max(int(y), 0), height - 1)
        above, below, share = integral[y0], integral[y0 + 1], y - y0
        for i in range(_CORNERS):
            x0 = np.uintp(places[i])
            x1 = x0 + np.uintp(1)
            first = above[x0] + share * (below[x0] - above[x0])
            second = above[x1] + share * (below[x1] - above[x1])
            lattice[j * _LINE + i * LANES] = first + shares[i] * (second - first)


@in_place()
def _first_corner(keypoint):  # type: ignore[no-untyped-def]
    """Its place in the integral image, and the distance to the next one, px."""
    step = STEP * keypoint[2]
    reach = 0.5 * (_CORNERS - 1) * step
    return keypoint[0] + 0.5 - reach, keypoint[1] + 0.5 - reach, step


@in_place()
def _haar_wavelets(lattice, line, dx, dy):  # type: ignore[no-untyped-def]
    """Wavelets of all samples, the first corner of each at the place of the sample."""
    for j in range(SAMPLES):
        above, centre = lattice[j * _LINE : (j + 1) * _LINE], lattice[(j + 1) * _LINE : (j + 2) * _LINE]
        below = lattice[(j + 2) * _LINE : (j + 3) * _LINE]
        for i in range(_LINE):
            line[i] = below[i] - above[i]
        out = dx[j * _LINE : (j + 1) * _LINE]
        for i in range(SAMPLES * LANES):
            out[i] = line[i] - 2.0 * line[i + LANES] + line[i + 2 * LANES]
        for i in range(_LINE):
            line[i] = below[i] - 2.0 * centre[i] + above[i]
        out = dy[j * _LINE : (j + 1) * _LINE]
        for i in range(SAMPLES * LANES):
            out[i] = line[i + 2 * LANES] - line[i]


@in_place()
def _clear_outside(integral, keypoint, dx, dy):  # type: ignore[no-untyped-def]
    """Wavelets that reach beyond the image are zero."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    left, top, step = _first_corner(keypoint)
    last = (_CORNERS - 1) * step
    if left >= 0.0 and top >= 0.0 and left + last <= width and top + last <= height:
        return
    for j in range(SAMPLES):
        for i in range(SAMPLES):
            x, y = left + i * step, top + j * step
            if x < 0.0 or y < 0.0 or x + 2.0 * step > width or y + 2.0 * step > height:
                dx[j * _LINE + i * LANES] = dy[j * _LINE + i * LANES] = np.float32(0.0)


@in_place()
def _sum_regions(dx, dy, weights, terms, rows, sums):  # type: ignore[no-untyped-def]
    """Weighted sums of the samples' terms over 4 x 4 subregions, first along the columns, then along the rows."""
    rows[:] = np.float32(0.0)
    sums[:] = np.float32(0.0)
    for j in range(SAMPLES):
        for i in range(SAMPLES):
            at = j * _LINE + i * LANES
            split_by_sign(dx[at : at + LANES], dy[at : at + LANES], LANES, terms)
            for region in range(_REGIONS):
                if weights[region, j] > 0.0:
                    _add(terms, weights[region, j], rows[region * SAMPLES + i])
    for region in range(_REGIONS):
        for column in range(_REGIONS):
            for i in range(SAMPLES):
                if weights[column, i] > 0.0:
                    _add(rows[region * SAMPLES + i], weights[column, i], sums[region * _REGIONS + column])


@in_place()
def _add(values, weight, out):  # type: ignore[no-untyped-def]
    for k in range(_CELL):
        out[k] += weight * values[k]


@in_place()
def _normalise(sums, scale, out):  # type: ignore[no-untyped-def]
    """Write the descriptors of the first keypoints, at unit length."""
    scale[:] = np.float32(0.0)
    for i in range(PAIR_DIMENSION):
        for k in range(LANES):
            scale[k] += sums[i * LANES + k] * sums[i * LANES + k]
    for k in range(LANES):
        scale[k] = np.float32(1.0) / max(np.sqrt(scale[k]), np.float32(1e-12))
    for k in range(len(out)):
        for i in range(PAIR_DIMENSION):
            out[k, i] = scale[k] * sums[i * LANES + k]
