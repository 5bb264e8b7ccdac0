# SPDX-License-Identifier: Apache-2.0
"""Compiled steps of :class:`~slam_experiments.planar.hypotheses.PlanarHypotheses`.

Hypotheses lie side by side: x (K, D), P (K, D, D), of which the first 3 + 2 used[k] rows count. They compute what
:class:`~slam_experiments.planar.ekf.PlanarEkf` does with the invariant error, one sighting at a time.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def predict(x, P, used, motion, Q):  # type: ignore[no-untyped-def]
    """Move every hypothesis by ``motion`` (3,) in its own frame, with covariance Q (3, 3), in place."""
    for k in range(len(x)):
        n = 3 + 2 * used[k]
        c, s = np.cos(x[k, 2]), np.sin(x[k, 2])
        dx, dy = c * motion[0] - s * motion[1], s * motion[0] + c * motion[1]
        x[k, 0] += dx
        x[k, 1] += dy
        x[k, 2] = _wrap(x[k, 2] + motion[2])
        for i in range(n):
            P[k, 0, i] -= dy * P[k, 2, i]
            P[k, 1, i] += dx * P[k, 2, i]
        for i in range(n):
            P[k, i, 0] -= dy * P[k, i, 2]
            P[k, i, 1] += dx * P[k, i, 2]
        G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        P[k, :3, :3] += G @ Q @ G.T


@njit(cache=True, nogil=True)
def scores(x, P, used, taken, z, R, gate):  # type: ignore[no-untyped-def]
    """Log likelihoods (K, M) of a sighting as each landmark's, minus infinity outside its gate or where it is taken."""
    out = np.full(taken.shape, -np.inf)
    H = np.empty((2, 5))
    for k in range(len(x)):
        for m in range(used[k]):
            if taken[k, m]:
                continue
            v0, v1 = _jacobian(x[k], m, z, H)
            a, b, d = R[0], 0.0, R[1]
            for i in range(5):
                r = i if i < 3 else 2 * m + i
                for j in range(5):
                    p = P[k, r, j if j < 3 else 2 * m + j]
                    a += H[0, i] * p * H[0, j]
                    b += H[0, i] * p * H[1, j]
                    d += H[1, i] * p * H[1, j]
            det = a * d - b * b
            nis = (d * v0 * v0 - 2.0 * b * v0 * v1 + a * v1 * v1) / det
            if nis < gate:
                out[k, m] = -0.5 * (nis + np.log(det)) - np.log(2.0 * np.pi)
    return out


@njit(cache=True, nogil=True)
def follow(x, P, used, choice, z, R):  # type: ignore[no-untyped-def]
    """Every hypothesis with the sighting of the landmark that it chose (K,), a new one if it is used[k]; in place."""
    for k in range(len(x)):
        n = 3 + 2 * used[k]
        if choice[k] < used[k]:
            _update(x[k], P[k], n, choice[k], z, R)
        else:
            _augment(x[k], P[k], n, z, R)
            used[k] += 1


@njit(cache=True, nogil=True)
def distinct(x, P, same):  # type: ignore[no-untyped-def]
    """Hypotheses (k,), the best first, whose pose differs from that of all kept before them.

    ``same``: squared Mahalanobis distance, by the covariance of the earlier one, below which two poses are the same.
    """
    kept = np.empty(len(x), np.int64)
    information = np.empty((len(x), 3, 3))
    count = 0
    for k in range(len(x)):
        for i in range(count):
            d = x[k, :3] - x[kept[i], :3]
            d[2] = _wrap(d[2])
            if d @ information[i] @ d < same:
                break
        else:
            kept[count] = k
            information[count] = np.linalg.inv(P[k, :3, :3])
            count += 1
    return kept[:count]


@njit(cache=True, nogil=True)
def _update(x, P, n, m, z, R):  # type: ignore[no-untyped-def]
    """One hypothesis, n numbers, with a sighting of its landmark m, in place; errors are invariant."""
    H = np.empty((2, 5))
    v0, v1 = _jacobian(x, m, z, H)
    PHt = np.zeros((n, 2))
    for i in range(n):
        for j in range(5):
            p = P[i, j if j < 3 else 2 * m + j]
            PHt[i, 0] += p * H[0, j]
            PHt[i, 1] += p * H[1, j]
    a, b, d = R[0], 0.0, R[1]
    for j in range(5):
        r = j if j < 3 else 2 * m + j
        a += H[0, j] * PHt[r, 0]
        b += H[0, j] * PHt[r, 1]
        d += H[1, j] * PHt[r, 1]
    L00 = np.sqrt(a)
    L10 = b / L00
    L11 = np.sqrt(d - L10 * L10)
    y0 = v0 / L00
    y1 = (v1 - L10 * y0) / L11
    W = np.empty((n, 2))
    W[:, 0] = PHt[:, 0] / L00
    W[:, 1] = (PHt[:, 1] - L10 * W[:, 0]) / L11
    A = _move(x, n, W[:, 0] * y0 + W[:, 1] * y1)
    B = P[2, :n] - W[:, 0] * W[2, 0] - W[:, 1] * W[2, 1]
    B += 0.5 * B[2] * A
    for i in range(n):
        for j in range(i + 1):
            P[i, j] += A[i] * B[j] + B[i] * A[j] - W[i, 0] * W[j, 0] - W[i, 1] * W[j, 1]
            P[j, i] = P[i, j]


@njit(cache=True, nogil=True)
def _augment(x, P, n, z, R):  # type: ignore[no-untyped-def]
    """A new landmark of one hypothesis in the rows n and n + 1, in place."""
    c, s = np.cos(x[2] + z[1]), np.sin(x[2] + z[1])
    x[n], x[n + 1] = x[0] + z[0] * c, x[1] + z[0] * s
    for i in range(n):
        P[n, i] = P[0, i] - z[0] * s * P[2, i]
        P[n + 1, i] = P[1, i] + z[0] * c * P[2, i]
    P[:n, n : n + 2] = P[n : n + 2, :n].T
    across = z[0] * z[0] * R[1]
    P[n, n] = P[n, 0] - z[0] * s * P[n, 2] + c * c * R[0] + s * s * across
    P[n, n + 1] = P[n, 1] + z[0] * c * P[n, 2] + c * s * (R[0] - across)
    P[n + 1, n] = P[n, n + 1]
    P[n + 1, n + 1] = P[n + 1, 1] + z[0] * c * P[n + 1, 2] + s * s * R[0] + c * c * across


@njit(cache=True, nogil=True)
def _jacobian(x, m, z, H):  # type: ignore[no-untyped-def]
    """Innovation of a sighting of landmark m; H (2, 5) becomes its Jacobian with respect to pose and landmark."""
    dx, dy = x[3 + 2 * m] - x[0], x[4 + 2 * m] - x[1]
    squared = max(dx * dx + dy * dy, 1e-12)
    r = np.sqrt(squared)
    H[0, 3], H[0, 4], H[1, 3], H[1, 4] = dx / r, dy / r, -dy / squared, dx / squared
    H[0, 0], H[0, 1], H[0, 2] = -H[0, 3], -H[0, 4], 0.0
    H[1, 0], H[1, 1], H[1, 2] = -H[1, 3], -H[1, 4], -1.0
    return z[0] - r, _wrap(z[1] - np.arctan2(dy, dx) + x[2])


@njit(cache=True, nogil=True)
def _move(x, n, step):  # type: ignore[no-untyped-def]
    """Apply an invariant error given in plain coordinates; returns by how much (n,) its coordinates turn with it."""
    angle = step[2]
    c, s = np.cos(angle), np.sin(angle)
    sine, cosine = (s / angle, (1.0 - c) / angle) if abs(angle) > 1e-9 else (1.0, 0.5 * angle)
    A = np.zeros(n)
    for i in range(0, n, 2):
        i += i > 0  # rows 0 and 1 are the position, then come 3 and 4, 5 and 6, ...
        if i + 1 >= n:
            break
        px, py = x[i], x[i + 1]
        ox, oy = step[i] + angle * py, step[i + 1] - angle * px
        x[i] = c * px - s * py + sine * ox - cosine * oy
        x[i + 1] = s * px + c * py + cosine * ox + sine * oy
        A[i], A[i + 1] = -(x[i + 1] - py), x[i] - px
    x[2] = _wrap(x[2] + angle)
    return A


@njit(cache=True, nogil=True)
def _wrap(angle):  # type: ignore[no-untyped-def]
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
