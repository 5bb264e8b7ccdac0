# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that register patches of the left image onto the right one; see :mod:`stereo_frontend.disparity`."""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.in_place import in_place

UNKNOWNS = 4
REORDER = {"reassoc", "contract"}
"""Licence that a sum needs to be vectorised; the rest of fastmath would forget that NaN exists."""
_MOST_ITERATIONS = 20
_CONVERGED = 0.01
_LEAST_ENERGY = 1.0
_ROUNDING_VARIANCE = 0.1
"""Variance of grey values rounded to integers, both images."""
_ONE = np.uintp(1)
"""Unsigned indices cannot be negative, so that the kernels need not look whether they count from the end."""


@njit(cache=True, nogil=True)
def align_patches(left, right, uv_left, u_right, row_offset, radius, max_shift, information, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 5): disparity, its variance, correlation, row shift, its variance; NaN where it fails.

    Variances come from residual and curvature.

    The unknowns ``p`` are corrections of the right patch: shift in u, shift in v, slopes of the shift in u along u and
    v. ``information`` (4,) is their prior's, ``row_offset`` (n,) px the row shift at which its mean lies.
    """
    n = (2 * radius + 1) ** 2
    template, patch = np.empty(n, np.float32), np.empty(n, np.float32)
    jacobian, line = np.empty((UNKNOWNS, n), np.float32), np.empty(right.shape[1], np.float32)
    normal, hessian = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    step, p = np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    for k in range(len(uv_left)):
        u, v = uv_left[k, 0], uv_left[k, 1]
        if not (np.isfinite(u) and np.isfinite(v) and np.isfinite(u_right[k])):
            continue
        energy = _take_template(left, u, v, radius, template, jacobian)
        if energy < _LEAST_ENERGY * n:
            continue
        _normal_matrix(jacobian, hessian)
        p[:] = 0.0
        length = 1.0
        for _ in range(_MOST_ITERATIONS):
            power = _sample_patch(right, u, v, u_right[k], row_offset[k], p, radius, line, patch)
            if power < _LEAST_ENERGY * n or abs(p[0]) > max_shift:
                break
            noise, correlation = _right_hand_side(template, patch, jacobian, energy, power, step)
            for i in range(UNKNOWNS):
                step[i] -= noise * information[i] * p[i]
                for j in range(UNKNOWNS):
                    normal[i, j] = hessian[i, j]
                normal[i, i] += noise * information[i]
            if length < _CONVERGED:
                out[k, 0] = u - u_right[k] - p[0]
                noise *= _correlation_factor(patch, radius)
                out[k, 2] = correlation
                out[k, 3] = row_offset[k] + p[1]
                for i in range(2):
                    out[k, 1 + 3 * i] = noise * _diagonal_of_inverse(normal, i)
                break
            if not _solve(normal, step):
                break
            length = abs(step[0]) + abs(step[1])
            scale = 1.0 / max(length, 1.0)
            for i in range(UNKNOWNS):
                p[i] += scale * step[i]


@in_place()
def _take_template(image, u, v, radius, template, jacobian):  # type: ignore[no-untyped-def]
    """Patch around the whole pixel nearest to (u, v), its Jacobian, means removed.

    Returns its energy, 0 at the border.
    """
    height, width = image.shape
    u0, v0 = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    if u0 < radius + 1 or v0 < radius + 1 or u0 > width - radius - 2 or v0 > height - radius - 2:
        return 0.0
    n, side, left = 0, 2 * radius + 1, np.uintp(u0 - radius)
    for y in range(v0 - radius, v0 + radius + 1):
        above, row, below = image[y - 1], image[y], image[y + 1]
        for i in range(side):
            x = left + np.uintp(i)
            gx = np.float32(0.5) * (np.float32(row[x + _ONE]) - np.float32(row[x - _ONE]))
            template[n] = row[x]
            jacobian[0, n] = gx
            jacobian[1, n] = np.float32(0.5) * (np.float32(below[x]) - np.float32(above[x]))
            jacobian[2, n] = gx * (u0 - radius + i - u)
            jacobian[3, n] = gx * (y - v)
            n += 1
    for i in range(UNKNOWNS):
        _remove_mean(jacobian[i])
    _remove_mean(template)
    return _dot(template, template)


@in_place()
def _sample_patch(image, u, v, u_right, row_offset, p, radius, line, patch):  # type: ignore[no-untyped-def]
    """Right patch, ``row_offset`` px lower and under the correction ``p``, bilinear, mean removed.

    Returns its energy, 0 at the border.

    ``line`` is room for a row of the image.
    """
    height, width = image.shape
    u0, v0 = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    stretch = 1.0 + p[2]
    reach = radius * stretch
    n = 0
    for j in range(-radius, radius + 1):
        y = v0 + j + row_offset + p[1]
        y0 = int(np.floor(y))
        middle = u_right + (u0 - u) + p[0] + p[2] * (u0 - u) + p[3] * (v0 + j - v)
        if reach <= 0.0 or middle < reach or middle + reach >= width - 1 or y0 < 0 or y0 >= height - 1:
            return np.float32(0.0)
        first, last = np.uintp(middle - reach), np.uintp(middle + reach) + _ONE
        above, below, share = image[y0], image[y0 + 1], np.float32(y - y0)
        for x in range(last - first + _ONE):
            value = np.float32(above[first + x])
            line[x] = value + share * (np.float32(below[first + x]) - value)
        for i in range(-radius, radius + 1):
            along = middle - np.float64(first) + i * stretch
            at = np.uintp(along)
            patch[n] = line[at] + np.float32(along - np.float64(at)) * (line[at + _ONE] - line[at])
            n += 1
    _remove_mean(patch)
    return _dot(patch, patch)


@in_place(fastmath=REORDER)
def _remove_mean(values):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(len(values)):
        total += values[i]
    mean = total / np.float32(len(values))
    for i in range(len(values)):
        values[i] -= mean


@in_place(fastmath=REORDER)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@in_place()
def _normal_matrix(jacobian, hessian):  # type: ignore[no-untyped-def]
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            hessian[i, j] = _dot(jacobian[i], jacobian[j])
            hessian[j, i] = hessian[i, j]


@in_place()
def _right_hand_side(template, patch, jacobian, energy, power, out):  # type: ignore[no-untyped-def]
    """Turn ``patch`` into the residual r after the best gain, fill ``out`` with ``J^T r``.

    Its variance and correlation.
    """
    cross = _dot(template, patch)
    gain = cross / power
    for i in range(len(patch)):
        patch[i] = template[i] - gain * patch[i]
    for i in range(UNKNOWNS):
        out[i] = _dot(jacobian[i], patch)
    freedom = len(template) - UNKNOWNS - 2
    return _dot(patch, patch) / freedom + _ROUNDING_VARIANCE, cross / np.sqrt(power * energy)


@in_place()
def _correlation_factor(residual, radius):  # type: ignore[no-untyped-def]
    """Factor of the variance that correlated noise leaves over that of white noise, ``(1 + 2 rho_u) (1 + 2 rho_v)``.

    Rectification interpolates, which makes neighbouring pixels share their noise: the residual's own correlation shows
    it.
    """
    side = 2 * radius + 1
    grid = residual.reshape(side, side)
    along, across = 0.0, 0.0
    for j in range(side):
        for i in range(side - 1):
            along += grid[j, i] * grid[j, i + 1]
            across += grid[i, j] * grid[i + 1, j]
    scale = 2.0 * side / (side - 1.0) / max(_dot(residual, residual), 1e-12)
    return (1.0 + max(0.0, scale * along)) * (1.0 + max(0.0, scale * across))


@njit(cache=True, nogil=True)
def _diagonal_of_inverse(matrix, index):  # type: ignore[no-untyped-def]
    """Diagonal element of the inverse of a positive definite matrix, infinite if it is none."""
    unit = np.zeros(matrix.shape[0])
    unit[index] = 1.0
    return unit[index] if _solve(matrix.copy(), unit) else np.inf


@in_place()
def _solve(matrix, vector):  # type: ignore[no-untyped-def]
    """Solve in place by Cholesky; False if the matrix is not positive definite."""
    n = len(vector)
    for j in range(n):
        for i in range(j, n):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = value / matrix[j, j]
            elif value <= 1e-12:
                return False
            else:
                matrix[j, j] = np.sqrt(value)
    for i in range(n):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
    return True
