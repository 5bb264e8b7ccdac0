# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the integral image that the box-filter Hessian reads, modulo 2^16, row by row.

Only the last ``KEPT_ROWS`` are kept, row y at ``y % KEPT_ROWS``: they stay in the cache, where a whole integral image
would be written to memory and read again. Rows are padded to whole cache lines, so that vectors are read aligned. Four
numbers at a time are summed along a row, as one word of 64 bits: a chain of single additions took twice as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place

KEPT_ROWS = 32
"""Power of two; the largest filter and the pixels around it reach over 30."""
_LINE = 32
"""Numbers of 16 bits in a cache line."""
_FOURS = np.uint64(0x0001000100010001)
_PART, _ONE, _TWO, _LAST = np.uint64(0xFFFF), np.uint64(16), np.uint64(32), np.uint64(48)


@njit(cache=True, nogil=True)
def integral_room(width):  # type: ignore[no-untyped-def]
    """Rows of the integral image, the first one filled, and room for :func:`next_integral_row`."""
    columns = (width // _LINE + 1) * _LINE
    shares = np.empty((3, width), np.uint16), np.empty((3, width), np.uint16)
    return np.zeros((KEPT_ROWS, columns), np.uint16), np.zeros(columns, np.uint16), np.empty(columns, np.uint16), shares


@in_place()
def next_integral_row(image, doubled, y, room):  # type: ignore[no-untyped-def]
    """Add row y of the image, or where ``doubled`` of the image enlarged twice, as row y + 1 of the integral image."""
    integral, row, before, shares = room
    if doubled:
        _doubled_row(image, y, shares, row)
    else:
        _copy(image[y], row)
    _sum_words(row.view(np.uint64))
    _sum_before(row.view(np.uint64), before.view(np.uint64))
    _add(before, row)
    _add(integral[y % KEPT_ROWS][1:], row)
    _copy(row[:-1], integral[(y + 1) % KEPT_ROWS][1:])


@in_place()
def _copy(values, out):  # type: ignore[no-untyped-def]
    for x in range(len(values)):
        out[x] = values[x]


@in_place()
def _doubled_row(image, y, shares, out):  # type: ignore[no-untyped-def]
    """Row y of the image enlarged twice, bilinear as OpenCV's ``resize`` does it.

    ``shares`` are those of the last three rows of the image, (3, 2 width) each.
    """
    (near, far), own, last = shares, y // 2, image.shape[0] - 1
    for source in range(own if y == 0 else own + 1, min(own + y % 2, last) + 1):
        _widen(image[source], near[source % 3], far[source % 3])
    other = min(own + 1, last) if y % 2 else max(own - 1, 0)
    _mean(near[own % 3], far[other % 3], out)


@in_place()
def _widen(row, near, far):  # type: ignore[no-untyped-def]
    """Shares, in quarters, of a row in the two rows nearest to it and in those beyond, at twice as many columns."""
    last = len(row) - 1
    for x in range(1, last):
        _widen_pixel(row[x - 1], row[x], row[x + 1], x, near, far)
    _widen_pixel(row[0], row[0], row[min(1, last)], 0, near, far)
    _widen_pixel(row[max(last - 1, 0)], row[last], row[last], last, near, far)


@in_place()
def _widen_pixel(before, own, after, x, near, far):  # type: ignore[no-untyped-def]
    most = np.uint16(3) * own
    left, right = np.uint16(before + most), np.uint16(most + after)
    near[2 * x], near[2 * x + 1] = np.uint16(3 * left) >> np.uint16(2), np.uint16(3 * right) >> np.uint16(2)
    far[2 * x], far[2 * x + 1] = left >> np.uint16(2), right >> np.uint16(2)


@in_place()
def _mean(near, far, out):  # type: ignore[no-untyped-def]
    for x in range(len(near)):
        out[x] = np.uint16(near[x] + far[x] + 2) >> np.uint16(2)


@in_place()
def _sum_words(words):  # type: ignore[no-untyped-def]
    """In every word of four numbers the sums up to each."""
    for i in range(len(words)):
        pairs = words[i] + (words[i] << _ONE)
        words[i] = pairs + (pairs << _TWO)


@in_place()
def _sum_before(words, before):  # type: ignore[no-untyped-def]
    """Four times the sum of all words before each, whose own sums are their last numbers."""
    total = np.uint64(0)
    for i in range(len(words)):
        before[i] = (total & _PART) * _FOURS
        total += words[i] >> _LAST


@in_place()
def _add(values, out):  # type: ignore[no-untyped-def]
    for x in range(len(values)):
        out[x] = np.uint16(out[x] + values[x])
