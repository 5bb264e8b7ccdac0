# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the box-filter Hessian (Bay et al. 2008, section 3.2), in whole numbers of 16 bits.

The integral image is kept modulo 2^16: the sum over a box is a difference of its corners and comes out exact as long as
it is below 2^16 itself, however often the corners have wrapped around. So each lobe of a filter is summed by itself,
and only what may leave that range, Dxx and Dyy, is put together in 32 bits. Half the bytes, twice the numbers per
vector register: half the time of a 32-bit integral image, with the same determinants to the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slam_core.runtime.in_place import in_place
from stereo_frontend.surf.surf_integral import KEPT_ROWS

FILTER_SIZES = (9, 15, 21, 27)
"""Edges (px) of the box filters of an octave."""
_LARGEST_IN_ROWS = 21
"""Edge (px) of the largest filter whose two outer lobes together stay below 2^16."""

_Index = np.uintp
"""Unsigned indices cannot be negative, so that the kernels need not look whether they count from the end."""
_ONE = _Index(1)


def row_filter(size: int) -> Any:
    """A kernel ``(integral, y, sums, out)`` for the filter of an edge of ``size`` px.

    It fills ``out`` with ``Dxx Dyy - (0.9 Dxy)^2`` of row y, normalised by the filter's area; the row's ends stay as
    they are. ``integral`` has the rows of :mod:`stereo_frontend.surf.surf_integral`; ``sums``, uint16 (4, columns), is
    room. The size is known to the compiler, which only so finds out that the shifted reads of one array do not overlap
    with what is written.
    """
    if size > _LARGEST_IN_ROWS:
        raise ValueError(f"lobes of a filter of {size} px do not stay below 2^16")
    lobe, half = size // 3, size // 2
    middle = lobe // 2
    far, right, left = _Index(2 * half + 1), _Index(half + middle + 1), _Index(half - middle)
    end, begin = _Index(half + lobe), _Index(half - lobe + 1)
    before, own, after, last = _Index(half - lobe), _Index(half), _Index(half + 1), _Index(half + lobe + 1)
    scale = np.float32(1.0 / (size * size))

    # No kernel among what this one encloses: the cache would take it for another one in every process.
    @in_place()
    def fill_row(integral, y, sums, out):  # type: ignore[no-untyped-def]
        column, inner, outer, cross = sums[0], sums[1], sums[2], sums[3]
        determinants = out[half : integral.shape[1] - 1 - half]
        # Column sums of Dxx's band, of Dyy's middle lobe and its other two, of Dxy's upper less its lower boxes.
        _difference(integral[_at(y + lobe)], integral[_at(y - lobe + 1)], column)
        _difference(integral[_at(y + middle + 1)], integral[_at(y - middle)], inner)
        _remainder(integral[_at(y + half + 1)], integral[_at(y - half)], inner, outer)
        _crossed(integral[_at(y)], integral[_at(y - lobe)], integral[_at(y + lobe + 1)], integral[_at(y + 1)], cross)
        for i in range(len(determinants)):
            x = _Index(i)
            within = np.uint16(column[x + right] - column[x + left])
            beside = np.uint16(column[x + far] - column[x] - within)
            above = np.uint16(outer[x + end] - outer[x + begin])
            between = np.uint16(inner[x + end] - inner[x + begin])
            xx, yy = np.int32(beside) - 2 * np.int32(within), np.int32(above) - 2 * np.int32(between)
            xy = np.int16(cross[x + own] - cross[x + before] - cross[x + last] + cross[x + after])
            dxx, dyy, dxy = np.float32(np.int32(xx)) * scale, np.float32(np.int32(yy)) * scale, np.float32(xy) * scale
            determinants[x] = dxx * dyy - np.float32(0.81) * dxy * dxy

    return fill_row


@in_place()
def _at(y):  # type: ignore[no-untyped-def]
    """Index of row y of the integral image among those kept."""
    return _Index(y) % _Index(KEPT_ROWS)


# Each of these loops has one array to write and few to read: with more of them the compiler gives up proving that they
# do not overlap, and vectorises nothing.
@in_place()
def _difference(plus, minus, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] = np.uint16(plus[x] - minus[x])


@in_place()
def _remainder(plus, minus, part, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] = np.uint16(plus[x] - minus[x] - part[x])


@in_place()
def _crossed(first, second, third, fourth, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] = np.uint16(first[x] - second[x] - third[x] + fourth[x])


@in_place()
def determinant_at(integral, x, y, size):  # type: ignore[no-untyped-def]
    """Determinant of the Hessian at one pixel, for a filter of any of the sizes."""
    x, y, lobe, half = _Index(x), _Index(y), _Index(size // 3), _Index(size // 2)
    middle = lobe // _Index(2)
    top, bottom = integral[_at(y - lobe + _ONE)], integral[_at(y + lobe)]
    xx = _box(top, bottom, x - half, x - middle) - 2 * _box(top, bottom, x - middle, x + middle + _ONE)
    xx += _box(top, bottom, x + middle + _ONE, x + half + _ONE)
    left, right = x - lobe + _ONE, x + lobe
    first, second, third, fourth = (
        integral[_at(y - half)],
        integral[_at(y - middle)],
        integral[_at(y + middle + _ONE)],
        integral[_at(y + half + _ONE)],
    )
    yy = _box(first, second, left, right) - 2 * _box(second, third, left, right) + _box(third, fourth, left, right)
    upper, above = integral[_at(y - lobe)], integral[_at(y)]
    below, lower = integral[_at(y + _ONE)], integral[_at(y + lobe + _ONE)]
    xy = _box(upper, above, x - lobe, x) - _box(upper, above, x + _ONE, x + lobe + _ONE)
    xy += _box(below, lower, x + _ONE, x + lobe + _ONE) - _box(below, lower, x - lobe, x)
    scale = np.float32(1.0 / (size * size))
    dxx, dyy, dxy = np.float32(xx) * scale, np.float32(yy) * scale, np.float32(xy) * scale
    return dxx * dyy - np.float32(0.81) * dxy * dxy


@in_place()
def _box(upper, lower, left, right):  # type: ignore[no-untyped-def]
    """Sum over the pixels between two rows and two columns of corners, below 2^16."""
    return np.int64(np.uint16(lower[right] - lower[left] - upper[right] + upper[left]))
