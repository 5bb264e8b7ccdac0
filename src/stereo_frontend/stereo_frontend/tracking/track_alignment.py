# SPDX-License-Identifier: Apache-2.0
"""Compiled kernel that registers the patches of key frames onto a later picture, each under an affine warp.

Inverse compositional Gauss-Newton (Baker and Matthews 2004): gradients are the reference's own, so that they are not
those of an interpolated picture. Gain and offset of brightness are eliminated. The four numbers of the affine part are
held near a prediction by a prior. Every patch is compared with the one in which its track began: errors of one frame
do not add up to those of the next.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place
from stereo_frontend.stereo.patch_alignment import (
    REORDER,
    diagonal_of_inverse,
    factorise,
    noise_of_residual,
    substitute,
)

UNKNOWNS = 6
OUTPUTS = 9
_MOST_ITERATIONS = 15
_CONVERGED = 0.05
"""Step at which an alignment ends, px."""
_LEAST_ENERGY = 4.0
"""Variance of the grey values of a patch that shows something."""
_ROUNDING_VARIANCE = 0.1
"""Variance of grey values rounded to integers, both pictures."""


@njit(cache=True, nogil=True)
def align_to_references(image, windows, offset, start, predicted, max_shift, information, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 9): place u, v; affine part (4,), row by row; variances of u and v; correlation. NaN: it failed.

    ``windows`` (n, side + 2, side + 2) are the references' grey values around a whole pixel, ``offset`` (n, 2) px what
    lies between that and the point tracked, ``start`` (n, 2) px where it is looked for, ``predicted`` (n, 4) its affine
    part, ``information`` the prior's of each of the four. A warp takes a place x relative to the point in the reference
    to ``(u, v) + A x``.
    """
    side = windows.shape[1] - 2
    n, freedom = side * side, side * side - UNKNOWNS - 2
    template, patch, inside = np.empty(n, np.float32), np.empty(n, np.float32), np.ones(n, np.float32)
    jacobian = np.empty((UNKNOWNS, n), np.float32)
    hessian, normal = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    projected, mean = np.empty(UNKNOWNS), np.empty(UNKNOWNS + 1)
    step, sums, place, prior = np.empty(UNKNOWNS), np.empty(UNKNOWNS + 3), np.empty(6), np.empty(4)
    for k in range(len(windows)):
        if not (np.isfinite(start[k, 0]) and np.isfinite(start[k, 1])):
            continue
        grey = _take_reference(windows[k], offset[k], template, jacobian)
        energy = _reference_sums(template, jacobian, hessian, projected, mean)
        if energy < _LEAST_ENERGY * n:
            continue
        place[0], place[1] = start[k, 0], start[k, 1]
        place[2:6] = predicted[k]
        length = np.inf
        for _ in range(_MOST_ITERATIONS):
            if abs(place[0] - start[k, 0]) + abs(place[1] - start[k, 1]) > max_shift:
                break
            if not _sample(image, place, offset[k], side, grey, patch):
                break
            _sums_of_patch(patch, template, jacobian, sums)
            total = sums[UNKNOWNS + 1]
            power, cross = sums[UNKNOWNS + 2] - total * total / n, sums[UNKNOWNS] - mean[UNKNOWNS] * total
            if power < _LEAST_ENERGY * n or cross <= 0.0:
                break
            gain = cross / power
            noise = max(energy - gain * cross, 0.0) / freedom + _ROUNDING_VARIANCE
            if not _deviation(predicted[k], place, prior):
                break
            for i in range(UNKNOWNS):
                step[i] = gain * (sums[i] - mean[i] * total) - projected[i]
                for j in range(UNKNOWNS):
                    normal[i, j] = hessian[i, j]
                if i >= 2:
                    step[i] += noise * information * prior[i - 2]
                    normal[i, i] += noise * information
            if not factorise(normal):
                break
            if length < _CONVERGED:
                noise = noise_of_residual(
                    template, patch, gain, mean[UNKNOWNS] - gain * total / n, inside, side, freedom
                )
                for i in range(6):
                    out[k, i] = place[i]
                vv = noise * diagonal_of_inverse(normal, 1, step)
                uu = noise * diagonal_of_inverse(normal, 0, step)
                out[k, 6] = place[2] ** 2 * uu + place[3] ** 2 * vv
                out[k, 7] = place[4] ** 2 * uu + place[5] ** 2 * vv
                out[k, 8] = cross / np.sqrt(power * energy)
                break
            substitute(normal, step)
            length = _compose(place, step, 0.5 * side)
            if not length < 4.0 * side:
                break


@in_place()
def _take_reference(window, offset, template, jacobian):  # type: ignore[no-untyped-def]
    """Fill the template, less its middle, which is returned, and its Jacobian by shift and affine part."""
    side = window.shape[0] - 2
    radius, half = side // 2, np.float32(0.5)
    grey = np.float32(window[radius + 1, radius + 1])
    n = 0
    for j in range(side):
        y = np.float32(j - radius - offset[1])
        for i in range(side):
            x = np.float32(i - radius - offset[0])
            along = half * (np.float32(window[j + 1, i + 2]) - np.float32(window[j + 1, i]))
            across = half * (np.float32(window[j + 2, i + 1]) - np.float32(window[j, i + 1]))
            template[n] = np.float32(window[j + 1, i + 1]) - grey
            jacobian[0, n], jacobian[1, n] = along, across
            jacobian[2, n], jacobian[3, n] = along * x, along * y
            jacobian[4, n], jacobian[5, n] = across * x, across * y
            n += 1
    return grey


@in_place(fastmath=REORDER)
def _product_sum(a, b):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@in_place(fastmath=REORDER)
def _sum(a):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i]
    return total


@in_place()
def _reference_sums(template, jacobian, hessian, projected, mean):  # type: ignore[no-untyped-def]
    """Fill ``hessian`` with ``J^T J`` and ``projected`` with ``J^T t``, means taken out; returns ``t^T t``."""
    n, last = len(template), len(jacobian)
    mean[last] = _sum(template) / n
    for i in range(last):
        mean[i] = _sum(jacobian[i]) / n
        projected[i] = _product_sum(jacobian[i], template) - n * mean[i] * mean[last]
        for j in range(i + 1):
            hessian[i, j] = _product_sum(jacobian[i], jacobian[j]) - n * mean[i] * mean[j]
            hessian[j, i] = hessian[i, j]
    return _product_sum(template, template) - n * mean[last] * mean[last]


@in_place()
def _sums_of_patch(patch, template, jacobian, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (9,): sums of the patch times Jacobian and template, of the patch, of its square."""
    for i in range(len(jacobian)):
        out[i] = _product_sum(jacobian[i], patch)
    out[6], out[7], out[8] = _product_sum(template, patch), _sum(patch), _product_sum(patch, patch)


@in_place()
def _sample(image, place, offset, side, grey, patch):  # type: ignore[no-untyped-def]
    """Fill the patch under a warp, less ``grey``, bilinear; False at the border."""
    height, width = image.shape
    radius = side // 2
    a, b, c, d = place[2], place[3], place[4], place[5]
    reach_u, reach_v = (radius + 0.5) * (abs(a) + abs(b)), (radius + 0.5) * (abs(c) + abs(d))
    u, v = place[0], place[1]
    if not (u - reach_u >= 0.0 and v - reach_v >= 0.0 and u + reach_u < width - 1 and v + reach_v < height - 1):
        return False
    step_u, step_v = np.float32(a), np.float32(c)
    n = np.uintp(0)
    one = np.uintp(1)
    for j in range(side):
        y, x = j - radius - offset[1], -radius - offset[0]
        at_u, at_v = np.float32(u + a * x + b * y), np.float32(v + c * x + d * y)
        for i in range(side):
            column, row = at_u + np.float32(i) * step_u, at_v + np.float32(i) * step_v
            left, top = np.uintp(np.int32(column)), np.uintp(np.int32(row))
            right, down = column - np.float32(left), row - np.float32(top)
            upper, lower = np.float32(image[top, left]), np.float32(image[top + one, left])
            upper += right * (np.float32(image[top, left + one]) - upper)
            lower += right * (np.float32(image[top + one, left + one]) - lower)
            patch[n] = upper + down * (lower - upper) - grey
            n += one
    return True


@in_place()
def _deviation(predicted, place, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (4,) with ``predicted^-1 A - I`` row by row; False if there is no inverse."""
    a, b, c, d = predicted[0], predicted[1], predicted[2], predicted[3]
    determinant = a * d - b * c
    if not determinant > 0.01:
        return False
    out[0] = (d * place[2] - b * place[4]) / determinant - 1.0
    out[1] = (d * place[3] - b * place[5]) / determinant
    out[2] = (a * place[4] - c * place[2]) / determinant
    out[3] = (a * place[5] - c * place[3]) / determinant - 1.0
    return True


@in_place(error_model="numpy")
def _compose(place, step, reach):  # type: ignore[no-untyped-def]
    """Compose the warp with the inverse of the step (6,); returns the step's length, px."""
    a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = a * d - b * c
    if not determinant > 0.1:
        return np.inf
    p, q, r, s = place[2], place[3], place[4], place[5]
    place[2], place[3] = (p * d - q * c) / determinant, (q * a - p * b) / determinant
    place[4], place[5] = (r * d - s * c) / determinant, (s * a - r * b) / determinant
    place[0] -= place[2] * step[0] + place[3] * step[1]
    place[1] -= place[4] * step[0] + place[5] * step[1]
    change = max(max(abs(step[2]), abs(step[3])), max(abs(step[4]), abs(step[5])))
    return abs(step[0]) + abs(step[1]) + 0.2 * reach * change
