# SPDX-License-Identifier: Apache-2.0
"""Kernels that register patches of the left image onto the right one (:mod:`stereo_frontend.stereo.disparity`).

Rows of a patch are padded to a multiple of 16 samples, the padding being zero in all that is summed: loops of a known
length are what the compiler turns into vector instructions.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam_core.runtime.in_place import in_place

UNKNOWNS = 4
REORDER = {"reassoc", "contract"}
"""Licence that a sum needs to be vectorised; the rest of fastmath would forget that NaN exists."""
_MOST_ITERATIONS = 20
_CONVERGED = 0.01
_LEAST_ENERGY = 1.0
_ROUNDING_VARIANCE = 0.1
"""Variance of grey values rounded to integers, both images."""
_MOST_SLOPE = 0.9
"""Change of the shift in u along u beyond which a patch is folded or torn apart."""
_LANES = 16
_FIRST_TAPS = 3
"""Pixels of a row that take part in a sample where the slope is small: two, and one more where the pair changes."""
_ONE, _TWO = np.uintp(1), np.uintp(2)
"""Unsigned indices cannot be negative, so that the kernels need not look whether they count from the end."""


@njit(cache=True, nogil=True)
def align_patches(left, right, uv_left, u_right, row_offset, radius, max_shift, information, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 5): disparity, its variance, correlation, row shift, its variance; NaN where it fails.

    Variances come from residual and curvature.

    The unknowns ``p`` are corrections of the right patch: shift in u, shift in v, slopes of the shift in u along u and
    v. ``information`` (4,) is their prior's, ``row_offset`` (n,) px the row shift at which its mean lies.
    """
    side = 2 * radius + 1
    stride = _LANES * ((side + _LANES - 1) // _LANES)
    n, freedom = side * side, side * side - UNKNOWNS - 2
    inside = np.zeros((side, stride), np.float32)
    inside[:, :side] = 1.0
    inside = inside.reshape(-1)
    columns, rows = np.empty(side * stride, np.float32), np.empty(side * stride, np.float32)
    for i in range(side * stride):
        columns[i], rows[i] = i % stride - radius, i // stride - radius
    template, patch = np.zeros(side * stride, np.float32), np.zeros(side * stride, np.float32)
    jacobian = np.zeros((UNKNOWNS, side * stride), np.float32)
    window, line = np.zeros((side + 2, stride + _LANES), np.float32), np.zeros(2 * stride, np.float32)
    normal, hessian = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS))
    step, p, projected = np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    mean, sums = np.empty(UNKNOWNS + 1), np.empty(UNKNOWNS + 3)
    for k in range(len(uv_left)):
        u, v = uv_left[k, 0], uv_left[k, 1]
        if not (np.isfinite(u) and np.isfinite(v) and np.isfinite(u_right[k])):
            continue
        if not _take_template(left, u, v, radius, inside, columns, rows, window, template, jacobian):
            continue
        grey = window[radius + 1, radius + 1]
        energy = _template_sums(template, jacobian, n, hessian, projected, mean)
        if energy < _LEAST_ENERGY * n:
            continue
        p[:] = 0.0
        length = 1.0
        for _ in range(_MOST_ITERATIONS):
            if abs(p[0]) > max_shift:
                break
            if not _sample_patch(right, u, v, u_right[k], row_offset[k], p, radius, grey, inside, line, patch):
                break
            _patch_sums(patch, template, jacobian, sums)
            total = sums[5]
            power, cross = sums[6] - total * total / n, sums[4] - mean[4] * total
            if power < _LEAST_ENERGY * n:
                break
            gain = cross / power
            noise = max(energy - gain * cross, 0.0) / freedom + _ROUNDING_VARIANCE
            for i in range(UNKNOWNS):
                step[i] = projected[i] - gain * (sums[i] - mean[i] * total) - noise * information[i] * p[i]
                for j in range(UNKNOWNS):
                    normal[i, j] = hessian[i, j]
                normal[i, i] += noise * information[i]
            if not factorise(normal):
                break
            if length < _CONVERGED:
                noise = noise_of_residual(template, patch, gain, mean[4] - gain * total / n, inside, side, freedom)
                out[k, 0] = u - u_right[k] - p[0]
                out[k, 2] = cross / np.sqrt(power * energy)
                out[k, 3] = row_offset[k] + p[1]
                for i in range(2):
                    out[k, 1 + 3 * i] = noise * diagonal_of_inverse(normal, i, step)
                break
            substitute(normal, step)
            length = abs(step[0]) + abs(step[1])
            scale = 1.0 / max(length, 1.0)
            for i in range(UNKNOWNS):
                p[i] += scale * step[i]


@in_place(fastmath=REORDER)
def _take_template(image, u, v, radius, inside, columns, rows, window, template, jacobian):  # type: ignore[no-untyped-def]
    """Patch around the whole pixel nearest to (u, v), less its middle, and its Jacobian; False at the border.

    ``columns`` and ``rows`` are the pixels' places from the middle. ``window`` is room for the grey values with a pixel
    more on every side.
    """
    height, width = image.shape
    u0, v0 = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    if u0 < radius + 1 or v0 < radius + 1 or u0 > width - radius - 2 or v0 > height - radius - 2:
        return False
    side, grey = 2 * radius + 1, np.float32(image[v0, u0])
    blocks, half = window.shape[1] // _LANES - 1, np.float32(0.5)
    along, across, along_u, along_v = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    left = np.uintp(u0 - radius - 1)
    for y in range(side + 2):
        row = image[v0 - radius - 1 + y]
        for i in range(min(window.shape[1], width - (u0 - radius - 1))):
            x = np.uintp(i)
            window[y, x] = np.float32(row[left + x])
    for y in range(side):
        above, row, below = window[y], window[y + 1], window[y + 2]
        for block in range(blocks):
            first, to = np.uintp(_LANES * block), np.uintp(_LANES * (y * blocks + block))
            for i in range(_LANES):
                x, n = first + np.uintp(i), to + np.uintp(i)
                template[n] = inside[n] * (row[x + _ONE] - grey)
            for i in range(_LANES):
                x, n = first + np.uintp(i), to + np.uintp(i)
                along[n] = inside[n] * half * (row[x + _TWO] - row[x])
            for i in range(_LANES):
                x, n = first + np.uintp(i), to + np.uintp(i)
                across[n] = inside[n] * half * (below[x + _ONE] - above[x + _ONE])
    du, dv = np.float32(u0 - u), np.float32(v0 - v)
    for i in range(len(template)):
        along_u[i] = along[i] * (columns[i] + du)
    for i in range(len(template)):
        along_v[i] = along[i] * (rows[i] + dv)
    return True


@in_place(fastmath=REORDER)
def _template_sums(template, jacobian, n, hessian, projected, mean):  # type: ignore[no-untyped-def]
    """Sums over the ``n`` pixels, the means taken out; returns the template's energy ``t^T t``.

    Filled are ``hessian`` with ``J^T J``, ``projected`` with ``J^T t``, ``mean`` (5,) with those of Jacobian and
    template.
    """
    J0, J1, J2, J3 = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    zero = np.float32(0.0)
    s0, s1, s2, s3, s4 = zero, zero, zero, zero, zero
    h00, h10, h11, h20, h21, h22 = zero, zero, zero, zero, zero, zero
    h30, h31, h32, h33, p0, p1, p2, p3, energy = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for i in range(len(template)):
        a, b, c, d, t = J0[i], J1[i], J2[i], J3[i], template[i]
        s0, s1, s2, s3, s4 = s0 + a, s1 + b, s2 + c, s3 + d, s4 + t
        h00, h10, h11, h20, h21, h22 = h00 + a * a, h10 + a * b, h11 + b * b, h20 + a * c, h21 + b * c, h22 + c * c
        h30, h31, h32, h33, energy = h30 + a * d, h31 + b * d, h32 + c * d, h33 + d * d, energy + t * t
        p0, p1, p2, p3 = p0 + a * t, p1 + b * t, p2 + c * t, p3 + d * t
    mean[0], mean[1], mean[2], mean[3], mean[4] = s0 / n, s1 / n, s2 / n, s3 / n, s4 / n
    hessian[0, 0], hessian[1, 0], hessian[1, 1], hessian[2, 0], hessian[2, 1] = h00, h10, h11, h20, h21
    hessian[2, 2], hessian[3, 0], hessian[3, 1], hessian[3, 2], hessian[3, 3] = h22, h30, h31, h32, h33
    projected[0], projected[1], projected[2], projected[3] = p0, p1, p2, p3
    for i in range(UNKNOWNS):
        projected[i] -= n * mean[i] * mean[4]
        for j in range(i + 1):
            hessian[i, j] -= n * mean[i] * mean[j]
            hessian[j, i] = hessian[i, j]
    return energy - n * mean[4] * mean[4]


@in_place(fastmath=REORDER)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@in_place(fastmath=REORDER)
def _sample_patch(image, u, v, u_right, row_offset, p, radius, grey, inside, line, patch):  # type: ignore[no-untyped-def]
    """Right patch less ``grey``, ``row_offset`` px lower and under the correction ``p``, bilinear; False at the border.

    A sample is the sum of the row's pixels, each with the weight ``max(0, 1 - distance)``: all pixels but two weigh
    nothing, and no pixel's place has to be looked up. ``line`` is room for a row of the image.
    """
    height, width = image.shape
    stretch, reach = 1.0 + p[2], radius * (1.0 + p[2])
    if not abs(p[2]) < _MOST_SLOPE:
        return False
    u0, v0 = np.floor(u + 0.5), int(np.floor(v + 0.5))
    side, stride = 2 * radius + 1, len(line) // 2
    one, zero, slope, span = np.float32(1.0), np.float32(0.0), np.float32(p[2]), p[2] * (stride - 1)
    for j in range(side):
        dv = v0 - radius + j - v
        y = v + dv + row_offset + p[1]
        begin = u_right + (u0 - u) * stretch + p[0] + p[3] * dv - reach
        y0 = int(np.floor(y))
        if not (begin >= 0.0 and begin + 2.0 * reach < width - 1 and 0 <= y0 < height - 1):
            return False
        lowest = int(np.floor(begin + min(span, 0.0)))
        taps = int(np.floor(begin + max(span, 0.0))) + 2 - lowest
        skipped, share = max(-lowest, 0), np.float32(y - y0)
        above, below = image[y0], image[y0 + 1]
        start, to = np.uintp(lowest + skipped), np.uintp(skipped)
        for i in range(min(2 * stride, width - lowest) - skipped):
            x = np.uintp(i)
            value = np.float32(above[start + x])
            line[to + x] = value + share * (np.float32(below[start + x]) - value) - grey
        offset = np.float32(begin - lowest)
        for block in range(0, stride, _LANES):
            first, to = np.uintp(block), np.uintp(j * stride + block)
            at = offset + slope * np.float32(block)
            for i in range(_LANES):
                x = first + np.uintp(i)
                t = at + slope * np.float32(i)
                value = max(one - abs(t), zero) * line[x]
                value += max(one - abs(t - one), zero) * line[x + _ONE]
                value += max(one - abs(t - one - one), zero) * line[x + _TWO]
                patch[to + np.uintp(i)] = inside[to + np.uintp(i)] * value
            for tap in range(_FIRST_TAPS, taps):
                for i in range(_LANES):
                    t = at + slope * np.float32(i) - np.float32(tap)
                    n = to + np.uintp(i)
                    patch[n] += inside[n] * max(one - abs(t), zero) * line[first + np.uintp(i) + np.uintp(tap)]
    return True


@in_place(fastmath=REORDER)
def _patch_sums(patch, template, jacobian, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (7,): sums of the patch times Jacobian and template, of the patch, of its square."""
    J0, J1, J2, J3 = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    zero = np.float32(0.0)
    total, power, cross, a, b, c, d = zero, zero, zero, zero, zero, zero, zero
    for i in range(len(patch)):
        value = patch[i]
        total += value
        power += value * value
        cross += value * template[i]
        a += value * J0[i]
        b += value * J1[i]
        c += value * J2[i]
        d += value * J3[i]
    out[0], out[1], out[2], out[3], out[4], out[5], out[6] = a, b, c, d, cross, total, power


@in_place(fastmath=REORDER)
def noise_of_residual(template, patch, gain, offset, inside, side, freedom):  # type: ignore[no-untyped-def]
    """Variance of the residual, times what correlated noise leaves over white: ``(1 + 2 rho_u) (1 + 2 rho_v)``.

    Rectification interpolates, which makes neighbouring pixels share their noise: the residual's own correlation shows
    it. ``patch`` becomes the residual.
    """
    stride = len(patch) // side
    gain, offset = np.float32(gain), np.float32(offset)
    for i in range(len(patch)):
        patch[i] = template[i] - gain * patch[i] - inside[i] * offset
    squares, along, across = _dot(patch, patch), _dot(patch[1:], patch[:-1]), _dot(patch[stride:], patch[:-stride])
    scale = 2.0 * side / (side - 1.0) / max(squares, 1e-12)
    factor = (1.0 + max(0.0, scale * along)) * (1.0 + max(0.0, scale * across))
    return (squares / freedom + _ROUNDING_VARIANCE) * factor


@in_place()
def factorise(matrix):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor in place; False if the matrix is not positive definite."""
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = value / matrix[j, j]
            elif not value > 1e-12:
                return False
            else:
                matrix[j, j] = np.sqrt(value)
    return True


@in_place()
def substitute(lower, vector):  # type: ignore[no-untyped-def]
    """Solve ``lower lower^T x = vector`` in place."""
    for i in range(len(lower)):
        for k in range(i):
            vector[i] -= lower[i, k] * vector[k]
        vector[i] /= lower[i, i]
    for i in range(len(lower) - 1, -1, -1):
        for k in range(i + 1, len(lower)):
            vector[i] -= lower[k, i] * vector[k]
        vector[i] /= lower[i, i]


@in_place()
def diagonal_of_inverse(lower, index, room):  # type: ignore[no-untyped-def]
    """Diagonal element of the inverse of ``lower lower^T``; ``room`` is filled."""
    total = 0.0
    for i in range(len(lower)):
        room[i] = 1.0 if i == index else 0.0
        for k in range(i):
            room[i] -= lower[i, k] * room[k]
        room[i] /= lower[i, i]
        total += room[i] * room[i]
    return total
