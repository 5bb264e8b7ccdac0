# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the motion between two frames: the best of many samples, and least squares from there.

``lens`` is fx, fy, cx, cy throughout; points are (n, 3) m with covariances (n, 3, 3), measured as z of variance (n, 3).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ekf_slam_node.association.pair_kernels import gated, normal_equations, pair_errors
from slam_core.camera import MIN_DEPTH
from slam_core.linear_algebra.small_kernels import rotate_columns
from slam_core.runtime.in_place import in_place

_MEDIAN_CHI2 = 0.4549
"""Median of chi-square with one degree of freedom."""
_MAX_EXCESS = 25.0


# ---- samples
@njit(cache=True, nogil=True, error_model="numpy")
def best_sample(points, covariances, z, variance, T_rig_optical, lens, draws, first, gate):  # type: ignore[no-untyped-def]
    """Motion T_now_previous (4, 4) of the optical frame with the least truncated cost (MSAC, Torr and Zisserman 2000).

    Competes with ``first`` (k, 4, 4): for each row of ``draws`` (h, 3), uniform in [0, 1), the motion of three pairs.
    """
    n = len(points)
    before, now, spread = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 2))
    _in_optical_frames(points, covariances, z, T_rig_optical, lens, before, now, spread)
    best, motion, least = np.eye(4), np.eye(4), np.inf
    sample = np.empty(3, np.int64)
    for h in range(len(first) + len(draws)):
        if h < len(first):
            motion[:] = first[h]
        else:
            draw_three(draws[h - len(first)], n, sample)
            motion_of_three(before, now, sample, motion)
        cost = _cost(motion, before, spread, z, variance, lens, gate, least)
        if cost < least:
            least = cost
            best[:] = motion
    return best


@in_place(error_model="numpy")
def _in_optical_frames(points, covariances, z, T, lens, before, now, spread):  # type: ignore[no-untyped-def]
    """Points before and now (n, 3) in the optical frames; the former's variances (n, 2): lateral, along the axis."""
    for n in range(len(points)):
        depth = 1.0 / z[n, 2]
        now[n, 0], now[n, 1] = (z[n, 0] - lens[2]) / lens[0] * depth, (z[n, 1] - lens[3]) / lens[1] * depth
        now[n, 2] = depth
        x, y, w = points[n, 0] - T[0, 3], points[n, 1] - T[1, 3], points[n, 2] - T[2, 3]
        C = covariances[n]
        spread[n, 0] = 0.0
        for i in range(3):
            a, b, c = T[0, i], T[1, i], T[2, i]
            before[n, i] = a * x + b * y + c * w
            own = a * a * C[0, 0] + b * b * C[1, 1] + c * c * C[2, 2]
            own += 2.0 * (a * b * C[1, 0] + a * c * C[2, 0] + b * c * C[2, 1])
            if i < 2:
                spread[n, 0] += 0.5 * own
            else:
                spread[n, 1] = own


@in_place()
def draw_three(draw, n, sample):  # type: ignore[no-untyped-def]
    """Three different numbers below n from three numbers in [0, 1)."""
    i, j, k = np.int64(draw[0] * n), np.int64(draw[1] * (n - 1)), np.int64(draw[2] * (n - 2))
    j += j >= i
    k += k >= min(i, j)
    k += k >= max(i, j)
    sample[0], sample[1], sample[2] = i, j, k


@in_place(error_model="numpy")
def motion_of_three(source, target, sample, T):  # type: ignore[no-untyped-def]
    """Fill T (4, 4) with the rigid motion that brings three points nearest to three others, in closed form.

    Least squares turn the plane of one triangle into that of the other, and there by the mean angle between the two
    triangles' corners around their centres. Points on one line give NaN.
    """
    i, j, k = sample[0], sample[1], sample[2]
    A, B = source, target
    # Bases e and f of the two planes: along the first edge, across it, and the normal.
    e0x, e0y, e0z, e1x, e1y, e1z, e2x, e2y, e2z = _basis(A[i], A[j], A[k])
    f0x, f0y, f0z, f1x, f1y, f1z, f2x, f2y, f2z = _basis(B[i], B[j], B[k])
    ax, ay, az = (A[i, 0] + A[j, 0] + A[k, 0]) / 3, (A[i, 1] + A[j, 1] + A[k, 1]) / 3, (A[i, 2] + A[j, 2] + A[k, 2]) / 3
    bx, by, bz = (B[i, 0] + B[j, 0] + B[k, 0]) / 3, (B[i, 1] + B[j, 1] + B[k, 1]) / 3, (B[i, 2] + B[j, 2] + B[k, 2]) / 3
    along = across = 0.0
    for m in range(3):
        x, y, z = A[sample[m], 0] - ax, A[sample[m], 1] - ay, A[sample[m], 2] - az
        p, q = e0x * x + e0y * y + e0z * z, e1x * x + e1y * y + e1z * z
        x, y, z = B[sample[m], 0] - bx, B[sample[m], 1] - by, B[sample[m], 2] - bz
        r, s = f0x * x + f0y * y + f0z * z, f1x * x + f1y * y + f1z * z
        along += p * r + q * s
        across += p * s - q * r
    length = np.sqrt(along * along + across * across)
    c, s = along / length, across / length
    # Columns of F turned by the angle, times the transposed E.
    g0x, g0y, g0z = c * f0x + s * f1x, c * f0y + s * f1y, c * f0z + s * f1z
    g1x, g1y, g1z = c * f1x - s * f0x, c * f1y - s * f0y, c * f1z - s * f0z
    T[0, 0], T[0, 1], T[0, 2] = _row(g0x, g1x, f2x, e0x, e0y, e0z, e1x, e1y, e1z, e2x, e2y, e2z)
    T[1, 0], T[1, 1], T[1, 2] = _row(g0y, g1y, f2y, e0x, e0y, e0z, e1x, e1y, e1z, e2x, e2y, e2z)
    T[2, 0], T[2, 1], T[2, 2] = _row(g0z, g1z, f2z, e0x, e0y, e0z, e1x, e1y, e1z, e2x, e2y, e2z)
    T[0, 3] = bx - (T[0, 0] * ax + T[0, 1] * ay + T[0, 2] * az)
    T[1, 3] = by - (T[1, 0] * ax + T[1, 1] * ay + T[1, 2] * az)
    T[2, 3] = bz - (T[2, 0] * ax + T[2, 1] * ay + T[2, 2] * az)


@in_place()
def _row(a, b, c, e0x, e0y, e0z, e1x, e1y, e1z, e2x, e2y, e2z):  # type: ignore[no-untyped-def]
    return a * e0x + b * e1x + c * e2x, a * e0y + b * e1y + c * e2y, a * e0z + b * e1z + c * e2z


@in_place(error_model="numpy")
def _basis(p, q, r):  # type: ignore[no-untyped-def]
    """Unit vectors along p to q, across it towards r, and their normal."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    u, v, w = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    length = np.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
    return x, y, z, b * z - c * y, c * x - a * z, a * y - b * x, a, b, c


@in_place(error_model="numpy")
def _cost(M, points, spread, z, variance, lens, gate, enough):  # type: ignore[no-untyped-def]
    """Truncated cost of a motion; what is beyond ``enough`` is not summed up to its end."""
    total = 0.0
    for i in range(len(points)):
        x = M[0, 0] * points[i, 0] + M[0, 1] * points[i, 1] + M[0, 2] * points[i, 2] + M[0, 3]
        y = M[1, 0] * points[i, 0] + M[1, 1] * points[i, 1] + M[1, 2] * points[i, 2] + M[1, 3]
        d = M[2, 0] * points[i, 0] + M[2, 1] * points[i, 1] + M[2, 2] * points[i, 2] + M[2, 3]
        cost = gate
        if d >= MIN_DEPTH:
            w = 1.0 / d
            du, dv, dw = z[i, 0] - lens[0] * x * w - lens[2], z[i, 1] - lens[1] * y * w - lens[3], z[i, 2] - w
            su = variance[i, 0] + spread[i, 0] * (lens[0] * w) ** 2
            sv = variance[i, 1] + spread[i, 0] * (lens[1] * w) ** 2
            sw = variance[i, 2] + spread[i, 1] * (w * w) ** 2
            cost = min(du * du / su + dv * dv / sv + dw * dw / sw, gate)
        total += cost
        if total >= enough:
            break
    return total


# ---- least squares
@njit(cache=True, nogil=True, error_model="numpy")
def refined(points, covariances, z, variance, mountings, lenses, ends, start, gate, iterations, error, S, J, depth):  # type: ignore[no-untyped-def]
    """Gauss-Newton from the motion ``start`` (4, 4), see :func:`ekf_slam_node.association.motion_guess.refine_motion`.

    The pairs of each camera, with its mounting (c, 4, 4) and lens (c, 4), end where ``ends`` (c,) says. Fills error, S,
    J and depth of the pairs. Returns whether a motion was found, T, its covariance (6, 6), mask of the inliers (n,),
    and by how much their errors exceed the claimed variances (3,).
    """
    T, covariance, camera = start.copy(), np.eye(6), np.eye(4)
    variance_scale, root, inliers = np.ones(3), np.ones(3), np.zeros(len(points), np.bool_)
    for step in range(iterations):
        first = 0
        for c in range(len(ends)):
            a, b = first, ends[c]
            first = b
            _product(T, mountings[c], camera)
            pair_errors(
                points[a:b], covariances[a:b], z[a:b], variance[a:b], camera, T[:3, 3], lenses[c], error[a:b], S[a:b],
                J[a:b], depth[a:b],
            )  # fmt: skip
        updated = gated(error, S, depth, root, gate * max(1.0, 4.0 - step))
        if updated.sum() < 4:
            return False, T, covariance, inliers, variance_scale
        if step > 3 and not (updated != inliers).any():
            break
        inliers = updated
        _excess(error, S, inliers, variance_scale)
        root = np.sqrt(np.maximum(variance_scale, 1.0))
        information, gradient = normal_equations(error, S, J, inliers, root)
        if not _inverse(information, covariance):
            return False, T, covariance, inliers, variance_scale
        _move(T, covariance, gradient)
    return True, T, covariance, inliers, variance_scale


@in_place()
def _product(A, B, out):  # type: ignore[no-untyped-def]
    """Rigid motion A B (4, 4)."""
    for i in range(3):
        for j in range(4):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j] + (A[i, 3] if j == 3 else 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(error, S, chosen, out):  # type: ignore[no-untyped-def]
    """By how much the chosen pairs' median squares of pixel and inverse depth errors exceed their variances (3,)."""
    pixels, depth, k = np.empty(2 * len(error)), np.empty(len(error)), 0
    for n in range(len(error)):
        if chosen[n]:
            pixels[2 * k] = error[n, 0] ** 2 / S[n, 0, 0] / _MEDIAN_CHI2
            pixels[2 * k + 1] = error[n, 1] ** 2 / S[n, 1, 1] / _MEDIAN_CHI2
            depth[k] = error[n, 2] ** 2 / S[n, 2, 2] / _MEDIAN_CHI2
            k += 1
    out[0] = out[1] = min(max(np.median(pixels[: 2 * k]), 0.25), _MAX_EXCESS)
    out[2] = min(max(np.median(depth[:k]), 0.25), _MAX_EXCESS)


@in_place(error_model="numpy")
def _inverse(A, out):  # type: ignore[no-untyped-def]
    """Fill out with the inverse of a positive definite matrix (6, 6), A with its factor; False if it is not."""
    for i in range(6):
        for j in range(i + 1):
            value = A[i, j]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            if i > j:
                A[i, j] = value / A[j, j]
            elif value > 0.0:
                A[i, i] = np.sqrt(value)
            else:
                return False
    for column in range(6):
        for i in range(6):
            value = 1.0 if i == column else 0.0
            for k in range(i):
                value -= A[i, k] * out[k, column]
            out[i, column] = value / A[i, i]
        for i in range(5, -1, -1):
            value = out[i, column]
            for k in range(i + 1, 6):
                value -= A[k, i] * out[k, column]
            out[i, column] = value / A[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _move(T, covariance, gradient):  # type: ignore[no-untyped-def]
    """Add the error ``covariance gradient`` (6,) to T, as ``slam_core.geometry.boxplus`` does."""
    delta = np.zeros(6)
    for i in range(6):
        for j in range(6):
            delta[i] += covariance[i, j] * gradient[j]
    rotate_columns(T, delta[3], delta[4], delta[5], 3)
    for i in range(3):
        T[i, 3] += delta[i]
