# SPDX-License-Identifier: Apache-2.0
"""CenSurE keypoints (Agrawal, Konolige and Blas, ECCV 2008), described as upright SURF.

The response at a pixel is the mean of an octagon less the mean of the ring around it, which stands for the Laplacian of
Gaussian. All seven sizes are taken at every pixel, so that a keypoint's place is as exact at the largest as at the
smallest. Extrema along a line, where one principal curvature of the response is small, are left out.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray
from stereo_frontend.keypoints import MOST_KEYPOINTS, DescribesAtOnce, Keypoints, Selector
from stereo_frontend.surf.surf import SurfConfig, describe
from stereo_frontend.surf.surf_detector import MAX_PIXELS, vertex

INNER = ((3, 0), (3, 1), (3, 2), (5, 2), (5, 3), (5, 4), (5, 5))
OUTER = ((5, 2), (5, 3), (7, 3), (9, 4), (9, 7), (13, 7), (15, 10))
"""Octagons of each size: length of an upright side and height of a slanted one, px (table 2 of the paper)."""
_WIDTHS = np.array([side + 2 * slant for side, slant in OUTER], np.float64)
_RESPONSE = 8.0
"""Customary threshold of the response, grey values 0 to 255."""
_LINE = 10.0
"""Largest ratio of the squared trace of the response's scatter matrix to its determinant."""
_LINE_REACH = 4
"""Half the edge of the window of that matrix, px, for the smallest size; it grows with the octagon."""
_SCALE_PER_SIZE = 1.2 / 9.0


class CensureDetector(DescribesAtOnce):
    """Finds CenSurE keypoints and describes them as ``surf`` says, along the axes of the image."""

    def __init__(self, surf: SurfConfig | None = None) -> None:
        self._surf = surf or SurfConfig()
        self._found = np.empty((MOST_KEYPOINTS, 4), np.float32)

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Keypoints above ``threshold`` times the customary one, thinned out by ``select``.

        Raises
        ------
        ValueError
            If the image is too large for 32-bit sums.
        """
        if image.size > MAX_PIXELS:
            raise ValueError(
                f"CenSurE takes images of at most {MAX_PIXELS} px, got {image.shape[1]} x {image.shape[0]}"
            )
        image = np.ascontiguousarray(image)
        number = find_extrema(responses(image), np.float32(threshold * _RESPONSE), self._found)
        found = self._found[:number].copy()
        found = found[select(found[:, :2], found[:, 2], found[:, 3])]
        places = np.column_stack([found[:, :2], _SCALE_PER_SIZE * found[:, 2]]).astype(np.float64)
        descriptors = describe(image, places, upright=True, extended=self._surf.extended)
        return Keypoints(found[:, :2].copy(), found[:, 2].copy(), found[:, 3].copy(), descriptors)


@njit(cache=True, nogil=True)
def responses(image: ByteArray):  # type: ignore[no-untyped-def]
    """Responses, float32 (7, height, width), of all sizes; 0 where the octagon does not fit in the image."""
    height, width = image.shape
    sums = _edge_sums(image)
    out = np.zeros((len(INNER), height, width), np.float32)
    for size in range(len(INNER)):
        inner, outer = INNER[size], OUTER[size]
        area = _octagon_area(inner)
        ring = _octagon_area(outer) - area
        reach = outer[0] // 2 + outer[1]
        for y in range(reach, height - reach):
            for x in range(reach, width - reach):
                middle = _octagon(sums, x, y, inner)
                around = _octagon(sums, x, y, outer) - middle
                out[size, y, x] = np.float32(middle) / np.float32(area) - np.float32(around) / np.float32(ring)
    return out


@in_place()
def _octagon_area(octagon):  # type: ignore[no-untyped-def]
    side, slant = octagon
    return (side + 2 * slant) ** 2 - 2 * slant * (slant + 1)


@njit(cache=True, nogil=True)
def _edge_sums(image):  # type: ignore[no-untyped-def]
    """Sums over everything left of an edge that runs down (0), down to the right (1), down to the left (2).

    int32 (3, height + 1, width + 1): entry (y + 1, x) ends with the pixels of row y left of column x.
    """
    height, width = image.shape
    sums = np.zeros((3, height + 1, width + 1), np.int32)
    for y in range(height):
        row = np.int32(0)
        for x in range(width + 1):
            if x > 0:
                row += np.int32(image[y, x - 1])
            sums[0, y + 1, x] = sums[0, y, x] + row
            sums[1, y + 1, x] = row + (sums[1, y, x - 1] if x > 0 else 0)
            sums[2, y + 1, x] = row + (sums[2, y, x + 1] if x < width else 0)
    return sums


@njit(cache=True, nogil=True, inline="always")
def _octagon(sums, x, y, octagon):  # type: ignore[no-untyped-def]
    """Sum over an octagon around a pixel: what lies left of its three right edges less what lies left of the others."""
    side, slant = octagon
    half = side // 2
    top, bottom = y - half, y + half + 1  # rows of the upright sides
    left, right = x - half - slant, x + half + slant + 1
    total = sums[0, bottom, right] - sums[0, top, right] - sums[0, bottom, left] + sums[0, top, left]
    if slant > 0:
        # Above: the right edge moves out by one per row down to right - 1, the left one likewise.
        total += sums[1, top, right - 1] - sums[1, top - slant, right - 1 - slant]
        total -= sums[2, top, left + 1] - sums[2, top - slant, left + 1 + slant]
        # Below: back in again.
        total += sums[2, bottom + slant, right - slant] - sums[2, bottom, right]
        total -= sums[1, bottom + slant, left + slant] - sums[1, bottom, left]
    return total


@njit(cache=True, nogil=True)
def find_extrema(response, threshold, found):  # type: ignore[no-untyped-def]
    """Write extrema of 3x3x3 neighbourhoods whose size exceeds ``threshold`` to ``found``; return their number.

    Rows of u, v, diameter of the octagon, size of the response; place and diameter are those of the parabola's vertex.
    """
    sizes, height, width = response.shape
    count = 0
    cube, offset = np.empty((3, 3, 3), np.float32), np.empty(3)
    for size in range(1, sizes - 1):
        border = OUTER[size + 1][0] // 2 + OUTER[size + 1][1] + 1
        for y in range(border, height - border):
            for x in range(border, width - border):
                value = response[size, y, x]
                if abs(value) <= threshold or count == len(found):
                    continue
                if not _is_extremum(response, size, y, x) or _is_on_line(response[size], y, x, size):
                    continue
                cube[:] = response[size - 1 : size + 2, y - 1 : y + 2, x - 1 : x + 2]
                if vertex(cube, offset):
                    step = _WIDTHS[size + 1] - _WIDTHS[size] if offset[2] > 0 else _WIDTHS[size] - _WIDTHS[size - 1]
                    found[count, 0], found[count, 1] = x + offset[0], y + offset[1]
                    found[count, 2], found[count, 3] = _WIDTHS[size] + offset[2] * step, abs(value)
                    count += 1
    return count


@in_place()
def _is_extremum(response, size, y, x):  # type: ignore[no-untyped-def]
    value = response[size, y, x]
    sign = np.float32(1.0) if value > 0 else np.float32(-1.0)
    for s in range(size - 1, size + 2):
        for j in range(y - 1, y + 2):
            for i in range(x - 1, x + 2):
                if (s != size or j != y or i != x) and sign * response[s, j, i] >= sign * value:
                    return False
    return True


@in_place()
def _is_on_line(response, y, x, size):  # type: ignore[no-untyped-def]
    """Harris's test of the response's gradients around a pixel: one direction in which it hardly changes."""
    reach = int(_LINE_REACH * _WIDTHS[size] / _WIDTHS[0])
    height, width = response.shape
    xx = xy = yy = 0.0
    for j in range(max(y - reach, 1), min(y + reach + 1, height - 1)):
        for i in range(max(x - reach, 1), min(x + reach + 1, width - 1)):
            dx = response[j, i + 1] - response[j, i - 1]
            dy = response[j + 1, i] - response[j - 1, i]
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
    return (xx + yy) ** 2 >= _LINE * (xx * yy - xy * xy)
