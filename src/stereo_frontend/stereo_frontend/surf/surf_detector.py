# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that find SURF keypoints: box-filter Hessian on the integral image (Bay et al. 2008, section 3).

A filter of size S stands for a Gaussian of scale ``1.2 S / 9``. An octave is an image of half the size of the one
before, searched with four filters. Those of the next octave are then twice as large, 18, 30, 42, 54, where the paper
enlarges the filters instead: 15, 27, 39, 51. So octaves adjoin instead of overlapping, no keypoint is found twice, and
each costs a quarter of the one before. Keypoints are maxima of the two middle sizes: these are filtered everywhere, the
outer two only around candidates, which saves half of the work. The filters are those of
:mod:`stereo_frontend.surf.surf_hessian`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray
from stereo_frontend.surf.surf_hessian import FILTER_SIZES, determinant_at, row_filter
from stereo_frontend.surf.surf_integral import integral_room, next_integral_row

MAX_PIXELS = 2**31 // 255
"""A larger image would overflow the 32-bit integral image."""

STEP = 6
"""From one size to the next."""
BORDERS = (14, 17)
"""Pixels from the edge within which no maximum of the two middle layers is looked for: half of the largest filter that
it is compared with, and one around it, and one for the vertex."""
_KEPT_ROWS = 4
"""Rows of determinants that are kept; a maximum needs three."""
_AHEAD = FILTER_SIZES[3] // 2
"""Rows by which the integral image precedes the layers: as far as the largest filter around a maximum reaches."""
_fill_smaller, _fill_larger = row_filter(FILTER_SIZES[1]), row_filter(FILTER_SIZES[2])

IntegralImage = npt.NDArray[np.int32]


def fitting_octaves(height: int, width: int, octaves: int) -> int:
    """Number of the given octaves whose filters fit an image (height, width) px."""
    return sum(2 * BORDERS[1] + 1 < min(height, width) >> octave for octave in range(octaves))


@njit(cache=True, nogil=True)
def find_keypoints(image, doubled, octaves, threshold, found):  # type: ignore[no-untyped-def]
    """Write keypoints above ``threshold`` to ``found`` rows u, v, scale, response; return their number.

    The first octave is that of the image, or where ``doubled`` of the image enlarged twice; u, v and scale are in its
    pixels. All in one call, so that no step waits for the interpreter.
    """
    count, pixel = 0, np.float32(1.0)
    for octave in range(octaves):
        enlarge = doubled and octave == 0
        number = find_maxima(image, enlarge, threshold, found[count:])
        for k in range(count, count + number):
            for axis in range(2):
                found[k, axis] = (found[k, axis] + np.float32(0.5)) * pixel - np.float32(0.5)
            found[k, 2] *= pixel
        count += number
        image, pixel = image if enlarge else halved(image), np.float32(2.0) * pixel
    return count


@njit(cache=True, nogil=True)
def halved(image):  # type: ignore[no-untyped-def]
    """Means of four pixels each, uint8 (height // 2, width // 2)."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    out = np.empty((height, width), np.uint8)
    for y in range(height):
        above, below, row = image[2 * y], image[2 * y + 1], out[y]
        for x in range(width):
            total = np.int32(above[2 * x]) + np.int32(above[2 * x + 1])
            row[x] = (total + np.int32(below[2 * x]) + np.int32(below[2 * x + 1]) + 2) >> 2
    return out


@njit(cache=True, nogil=True)
def integral_image(image: ByteArray) -> IntegralImage:
    """Sums over all pixels above and to the left, int32 (height + 1, width + 1)."""
    height, width = image.shape
    out = np.zeros((height + 1, width + 1), np.int32)
    for y in range(height):
        above, here, row = out[y, 1:], out[y + 1, 1:], image[y]
        total = np.int32(0)
        for x in range(width):
            total += np.int32(row[x])
            here[x] = above[x] + total
    return out


@njit(cache=True, nogil=True)
def find_maxima(image, doubled, threshold, found):  # type: ignore[no-untyped-def]
    """Write maxima of 3x3x3 neighbourhoods above ``threshold`` to ``found`` rows u, v, scale, response.

    Return their number. Where ``doubled`` the image is searched enlarged twice, and u, v and scale are in its pixels.

    Integral image, both middle layers and their maxima follow each other row by row, while the last rows are in the
    cache.
    """
    size = (2 * image.shape[0], 2 * image.shape[1]) if doubled else image.shape
    rows = integral_room(size[1])
    columns = rows[0].shape[1]
    sums = np.empty((4, columns), np.uint16)
    layers = np.zeros((2, _KEPT_ROWS, columns), np.float32)
    marks, cube = np.zeros(columns, np.uint8), np.empty((3, 3, 3), np.float32)
    return _find_in_rows(image, doubled, size, rows, threshold, sums, layers, marks, cube, np.empty(3), found)


@in_place()
def _find_in_rows(image, doubled, size, rows, threshold, sums, layers, marks, cube, offset, found):  # type: ignore[no-untyped-def]
    """Loop over the rows; what comes between ``size`` and ``found``, but for ``threshold``, is room."""
    (height, width), integral = size, rows[0]
    count = 0
    for newest in range(height + _AHEAD):
        if newest < height:
            next_integral_row(image, doubled, newest, rows)
        y = newest - _AHEAD
        if FILTER_SIZES[1] // 2 <= y < height - FILTER_SIZES[1] // 2:
            _fill_smaller(integral, y, sums, layers[0, y % _KEPT_ROWS])
        if FILTER_SIZES[2] // 2 <= y < height - FILTER_SIZES[2] // 2:
            _fill_larger(integral, y, sums, layers[1, y % _KEPT_ROWS])
        for place in range(2):
            if BORDERS[place] <= y - 1 < height - BORDERS[place]:
                count += _find_in_row(
                    integral, width, layers, place, y - 1, threshold, marks, cube, offset, found[count:]
                )
    return count


@in_place()
def _find_in_row(integral, width, layers, place, y, threshold, marks, cube, offset, found):  # type: ignore[no-untyped-def]
    """Maxima of one row of one layer.

    Their position and scale are those of the vertex of the parabola through the neighbourhood (Brown and Lowe 2002).
    """
    size, outer, border = FILTER_SIZES[place + 1], FILTER_SIZES[3 * place], BORDERS[place]
    rows = ((y - 1) % _KEPT_ROWS, y % _KEPT_ROWS, (y + 1) % _KEPT_ROWS)
    own, other = layers[place], layers[1 - place]
    above, here, below = own[rows[0]], own[rows[1]], own[rows[2]]
    other_above, other_here, other_below = other[rows[0]], other[rows[1]], other[rows[2]]
    count, end = 0, width - border
    _mark_peaks(above, here, below, threshold, marks)
    eights = marks.view(np.uint64)
    for eight in range(border // 8, (end + 7) // 8):
        if eights[eight] == 0:
            continue
        for x in range(max(8 * eight, border), min(8 * eight + 8, end)):
            if not marks[x] or count == len(found):
                continue
            value = here[x]
            if not (_is_higher(above, x, value) and _is_higher(below, x, value)):
                continue
            if not (_is_higher(other_above, x, value) and _is_higher(other_here, x, value)):
                continue
            if not _is_higher(other_below, x, value):
                continue
            if not _fill_outer(integral, x, y, outer, value, cube[2 * place]):
                continue
            for j in range(3):
                for i in range(3):
                    cube[1, j, i], cube[2 - 2 * place, j, i] = own[rows[j], x - 1 + i], other[rows[j], x - 1 + i]
            if vertex(cube, offset):
                found[count, 0] = x + offset[0]
                found[count, 1] = y + offset[1]
                found[count, 2] = 1.2 / 9.0 * (size + offset[2] * STEP)
                found[count, 3] = value
                count += 1
    return count


@in_place()
def _mark_peaks(above, here, below, threshold, marks):  # type: ignore[no-untyped-def]
    """Mark values of a row that are above ``threshold`` and their four neighbours."""
    for x in range(1, len(here) - 1):
        around = max(max(above[x], below[x]), max(here[x - 1], here[x + 1]))
        marks[x] = here[x] > max(around, threshold)


@in_place()
def _is_higher(row, x, value):  # type: ignore[no-untyped-def]
    """Than the three pixels of another row or layer that are next to it."""
    return value > row[x - 1] and value > row[x] and value > row[x + 1]


@in_place()
def _fill_outer(integral, x, y, size, value, out):  # type: ignore[no-untyped-def]
    """Determinants (3, 3) of a layer that is not filtered everywhere; False as soon as one is not below ``value``.

    The one in the middle, which is the largest most often, comes first.
    """
    for k in range(9):
        j, i = (k + 4) % 9 // 3, (k + 4) % 3
        out[j, i] = determinant_at(integral, x + i - 1, y + j - 1, size)
        if out[j, i] >= value:
            return False
    return True


@in_place()
def vertex(c, offset):  # type: ignore[no-untyped-def]
    """Vertex of the parabola through a neighbourhood (scale, v, u) relative to its centre; False if it lies outside."""
    centre = np.float64(c[1, 1, 1])
    gx = 0.5 * (c[1, 1, 2] - c[1, 1, 0])
    gy = 0.5 * (c[1, 2, 1] - c[1, 0, 1])
    gs = 0.5 * (c[2, 1, 1] - c[0, 1, 1])
    xx = c[1, 1, 2] + c[1, 1, 0] - 2.0 * centre
    yy = c[1, 2, 1] + c[1, 0, 1] - 2.0 * centre
    ss = c[2, 1, 1] + c[0, 1, 1] - 2.0 * centre
    xy = 0.25 * (c[1, 2, 2] - c[1, 2, 0] - c[1, 0, 2] + c[1, 0, 0])
    xs = 0.25 * (c[2, 1, 2] - c[2, 1, 0] - c[0, 1, 2] + c[0, 1, 0])
    ys = 0.25 * (c[2, 2, 1] - c[2, 0, 1] - c[0, 2, 1] + c[0, 0, 1])
    m00, m01, m02 = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
    determinant = xx * m00 + xy * m01 + xs * m02
    if abs(determinant) < 1e-30:
        return False
    offset[0] = -(m00 * gx + m01 * gy + m02 * gs) / determinant
    offset[1] = -(m01 * gx + (xx * ss - xs * xs) * gy + (xy * xs - xx * ys) * gs) / determinant
    offset[2] = -(m02 * gx + (xy * xs - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
    return abs(offset[0]) <= 0.6 and abs(offset[1]) <= 0.6 and abs(offset[2]) <= 0.6
