# SPDX-License-Identifier: Apache-2.0
"""Partners of keypoints in the other image of a rectified pair, by normalised correlation of patches along the row.

Every disparity that the depth range allows is tried, so the other image needs no keypoints of its own: to find and
describe them took a fifth of the time of mapping. Correlation does not mind gain and offset of brightness. The best
place must be clearly better than the second best apart from it, as of descriptors.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.in_place import in_place
from slam_core.types import ByteArray, Float32Array

_RADIUS = 7
"""Half width of the patch, px."""
_SIDE = 2 * _RADIUS + 1
_TAPS = 3
"""Columns of a patch that are multiplied at a time; divides its side."""
_APART = 3
"""A place so many columns from the best is another place."""
_MIN_CORRELATION = 0.85
"""Least correlation of the best place."""
_MAX_RATIO = 0.7
"""Most ratio of the best to the second-best distance, ``sqrt(2 - 2 correlation)``."""
_ROUNDING = 1e-3
"""Shortfall from one of a perfect partner's correlation, by rounding."""
_LEAST_ENERGY = 1.0
"""Variance of grey values below which a patch shows nothing."""


def search_rows(
    left: ByteArray,
    right: ByteArray,
    uv: Float32Array,
    row_error: Float32Array,
    bounds: tuple[float, float],
) -> Float32Array:
    """Columns (n,) px in the right image of the partners of keypoints (n, 2) px of the left one, NaN where unclear.

    Parameters
    ----------
    left, right
        Rectified images, uint8 (height, width).
    uv
        Keypoints of the left image.
    row_error
        Rows (n,) px by which the partners lie lower.
    bounds
        Least and greatest disparity, px.
    """
    out = np.full((len(uv), 3), np.nan, np.float32)
    _search(left, right, uv, row_error, float(bounds[0]), float(bounds[1]), out)
    column, best, second = out.T
    difference = np.maximum(1.0 - best, _ROUNDING)
    clear = (best >= _MIN_CORRELATION) & (difference <= _MAX_RATIO**2 * (1.0 - second))
    return np.where(clear, column, np.float32(np.nan))


@njit(cache=True, nogil=True)
def _search(left, right, uv, row_error, least, greatest, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 3): column of the best place, its correlation and that of the second best."""
    width = right.shape[1]
    template, lines = np.empty(_SIDE * _SIDE, np.float32), np.empty(width, np.float32)
    products, sums, squares = np.empty(width, np.float32), np.empty(width, np.int32), np.empty(width, np.int32)
    for k in range(len(uv)):
        _search_one(left, right, uv[k], row_error[k], least, greatest, template, lines, products, sums, squares, out[k])


@in_place()
def _search_one(left, right, uv, row_error, least, greatest, template, line, products, sums, squares, out):  # type: ignore[no-untyped-def]
    height, width = right.shape
    u0, v0 = int(np.floor(uv[0] + 0.5)), int(np.floor(uv[1] + 0.5))
    y = v0 + int(np.floor(row_error + 0.5))
    last = min(u0 - int(np.floor(least)), width - 1 - _RADIUS)
    first = max(u0 - int(np.ceil(greatest)), _RADIUS)
    n = last - first + 1
    if n < 3 or u0 < _RADIUS or u0 >= width - _RADIUS or min(v0, y) < _RADIUS or max(v0, y) >= height - _RADIUS:
        return
    energy = _take_template(left, u0, v0, template)
    if energy < _LEAST_ENERGY * _SIDE * _SIDE:
        return
    _correlate(right, y, first - _RADIUS, n, template, line, products, sums, squares)
    _divide(products[:n], sums, squares, energy)
    best = _argmax(products[:n])
    value = products[best]
    second = np.float32(-1.0)
    for x in range(n):
        if abs(x - best) >= _APART and products[x] > second:
            second = products[x]
    out[0] = first + best + uv[0] - u0
    if 0 < best < n - 1:
        before, after = products[best - 1], products[best + 1]
        out[0] += np.float32(0.5) * (before - after) / (before - value - value + after - np.float32(1e-6))
    out[1], out[2] = value, second


@in_place()
def _take_template(image, u0, v0, template):  # type: ignore[no-untyped-def]
    """Patch without its mean; returns its energy."""
    total, n = np.float32(0.0), 0
    for y in range(v0 - _RADIUS, v0 + _RADIUS + 1):
        row = image[y]
        for x in range(u0 - _RADIUS, u0 + _RADIUS + 1):
            template[n] = row[x]
            total += template[n]
            n += 1
    mean, energy = total / np.float32(n), np.float32(0.0)
    for i in range(n):
        template[i] -= mean
        energy += template[i] * template[i]
    return energy


@in_place()
def _correlate(image, y, start, n, template, line, products, sums, squares):  # type: ignore[no-untyped-def]
    """Products of the template with the ``n`` patches around row ``y`` from column ``start`` on.

    Also the sums and sums of squares of every column of the band, each over its rows.
    """
    wide = n + _SIDE - 1
    for x in range(wide):
        sums[x] = squares[x] = 0
    for x in range(n):
        products[x] = np.float32(0.0)
    for j in range(_SIDE):
        row = image[y - _RADIUS + j][start : start + wide]
        _add_column_sums(row, sums)
        _add_column_squares(row, squares)
        for x in range(wide):
            line[x] = row[x]
        for i in range(0, _SIDE, _TAPS):
            at = j * _SIDE + i
            _add_taps(line[i:], template[at], template[at + 1], template[at + 2], products[:n])


@in_place()
def _add_column_sums(row, sums):  # type: ignore[no-untyped-def]
    for x in range(len(row)):
        sums[x] += np.int32(row[x])


@in_place()
def _add_column_squares(row, squares):  # type: ignore[no-untyped-def]
    for x in range(len(row)):
        squares[x] += np.int32(row[x]) * np.int32(row[x])


@in_place()
def _add_taps(line, a, b, c, out):  # type: ignore[no-untyped-def]
    for x in range(len(out)):
        out[x] += a * line[x] + b * line[x + 1] + c * line[x + 2]


@in_place()
def _divide(products, sums, squares, energy):  # type: ignore[no-untyped-def]
    """Turn products into correlations, with running sums over the patches' columns."""
    total, square, area = 0, 0, _SIDE * _SIDE
    for x in range(_SIDE - 1):
        total += sums[x]
        square += squares[x]
    for x in range(len(products)):
        total += sums[x + _SIDE - 1]
        square += squares[x + _SIDE - 1]
        power = np.float32(square) - np.float32(total) * np.float32(total) / np.float32(area)
        if power < _LEAST_ENERGY * area:
            products[x] = np.float32(-1.0)
        else:
            products[x] /= np.sqrt(power * energy)
        total -= sums[x]
        square -= squares[x]


@in_place()
def _argmax(values):  # type: ignore[no-untyped-def]
    best = 0
    for x in range(1, len(values)):
        if values[x] > values[best]:
            best = x
    return best
