# SPDX-License-Identifier: Apache-2.0
"""The compiled parts of dense stereo: what only one camera sees, and the sub-pixel step with its sigma.

Sums over windows are sums over columns, which move down with the rows, added up along each row that is kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, Float32Array

_SUMS = 6
"""Known pixels, residual r, gradient g, r^2, g^2 and g r."""


class StepNoise(NamedTuple):
    """Parameters of the step and of its sigma.

    image: standard deviation of a grey value; matched: of the matcher's disparity, px; scale: factor on sigma; floor:
    smallest sigma, px; largest_step: beyond it a pixel is dropped, px; least_known: share of a window, else dropped.
    """

    image: float
    matched: float
    scale: float
    floor: float
    largest_step: float
    least_known: float


@njit(cache=True, nogil=True, error_model="numpy")
def refine(
    left: ByteArray, right: ByteArray, disparity: Float32Array, window: int, spacing: int, noise: StepNoise
) -> tuple[Float32Array, Float32Array]:  # pragma: no cover - compiled
    """Disparity after a Gauss-Newton step and its sigma, px, of one pixel of ``spacing`` in rows and columns.

    left, right, disparity: (height, width), disparity NaN where it is not known. NaN where the result is not trusted.
    """
    height, width = disparity.shape
    radius = window // 2
    shape = ((height + spacing - 1) // spacing, (width + spacing - 1) // spacing)
    refined, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    rows = np.empty((window, _SUMS, width), np.float32)
    columns, warped = np.zeros((_SUMS, width)), np.empty(width, np.float32)
    for row in range(height):
        for last in range(-radius if row == 0 else row + radius, row + radius + 1):
            terms = rows[last % window]
            if last - window >= -radius:
                _add(columns, terms, -1.0)
            _terms(left, right, disparity, min(max(last, 0), height - 1), warped, terms)
            _add(columns, terms, 1.0)
        if row % spacing == 0:
            _step_along_row(
                columns, disparity[row], radius, spacing, noise, (refined[row // spacing], sigma[row // spacing])
            )
    return refined, sigma


@in_place()
def _add(columns: FloatArray, terms: Float32Array, sign: float) -> None:  # pragma: no cover - compiled
    for k in range(_SUMS):
        for u in range(columns.shape[1]):
            columns[k, u] += sign * terms[k, u]


@in_place(error_model="numpy")
def _terms(
    left: ByteArray, right: ByteArray, disparity: Float32Array, row: int, warped: Float32Array, out: Float32Array
) -> None:  # pragma: no cover - compiled
    """Terms of the sums (6, width) of a row; ``warped`` (width,) is room for the right image at the left pixels."""
    width = disparity.shape[1]
    for u in range(width):
        d = disparity[row, u]
        known = d == d
        place = min(max(u - (d if known else np.float32(0.0)), np.float32(0.0)), np.float32(width - 1))
        lower = np.int64(place)
        upper = min(lower + 1, width - 1)
        part = place - np.float32(lower)
        warped[u] = (1 - part) * right[row, lower] + part * right[row, upper]
        out[0, u] = np.float32(known)
    for u in range(width):
        before, after = max(u - 1, 0), min(u + 1, width - 1)
        inside = np.float32(0.25 if 0 < u < width - 1 else 0.0)  # mirrored edges have no gradient
        slope = np.float32(left[row, after]) - np.float32(left[row, before]) + warped[after] - warped[before]
        g, r, known = inside * slope, warped[u] - np.float32(left[row, u]), out[0, u]
        out[1, u], out[2, u], out[3, u], out[4, u], out[5, u] = (
            known * r, known * g, known * r * r, known * g * g, known * g * r,
        )  # fmt: skip


@in_place(error_model="numpy")
def _step_along_row(
    columns: FloatArray,
    disparity: Float32Array,
    radius: int,
    spacing: int,
    noise: StepNoise,
    out: tuple[Float32Array, Float32Array],
) -> None:  # pragma: no cover - compiled
    """Disparities and sigmas of a row that is kept, from the sums (6, width) over columns."""
    width = columns.shape[1]
    size = (2 * radius + 1) ** 2
    variance_of_grey = noise.image * noise.image
    count = sum_r = sum_g = sum_rr = sum_gg = sum_gr = 0.0
    for end in range(-radius, width + radius):
        new = min(max(end, 0), width - 1)
        count += columns[0, new]
        sum_r += columns[1, new]
        sum_g += columns[2, new]
        sum_rr += columns[3, new]
        sum_gg += columns[4, new]
        sum_gr += columns[5, new]
        u = end - radius
        if u < 0:
            continue
        if u > 0:
            old = max(u - radius - 1, 0)
            count -= columns[0, old]
            sum_r -= columns[1, old]
            sum_g -= columns[2, old]
            sum_rr -= columns[3, old]
            sum_gg -= columns[4, old]
            sum_gr -= columns[5, old]
        d = disparity[u]
        if u % spacing or d != d or count < noise.least_known * size:
            continue
        offset, slope = sum_r / count, sum_g / count
        energy = max(sum_gg - count * (slope * slope + 0.25 * variance_of_grey), 1e-3)
        product = sum_gr - count * slope * offset
        spread = noise.scale**2 * max(sum_rr / count - offset * offset, 2.0 * variance_of_grey)
        # warped(u) = R(u - d): a larger d moves the right image to the right, so dr/dd = -g.
        information = energy + spread / noise.matched**2
        step = product / information
        if abs(step) < noise.largest_step and d + step > 0.5:
            out[0][u // spacing] = d + step
            out[1][u // spacing] = np.sqrt(spread / information + noise.floor**2)


@in_place()
def drop_occluded(disparity: Float32Array, most: float, nearest: Float32Array) -> None:  # pragma: no cover - compiled
    """Set those disparities (h, w) of the left image to NaN that the right camera cannot see.

    At their partner, which may lie outside of the right image, another one is larger by more than ``most``: it is
    nearer. ``nearest`` (w,): room for the largest disparity at each pixel of a row of the right image.
    """
    for row in range(disparity.shape[0]):
        nearest[:] = 0.0
        for u in range(disparity.shape[1]):
            d = disparity[row, u]
            partner = np.int64(np.rint(u - d)) if d == d else -1
            if partner >= 0:
                nearest[partner] = max(nearest[partner], d)
        for u in range(disparity.shape[1]):
            d = disparity[row, u]
            partner = np.int64(np.rint(u - d)) if d == d else -1
            if partner < 0 or d < nearest[partner] - most:
                disparity[row, u] = np.nan
