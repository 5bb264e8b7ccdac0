# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels of the measurement model: what a frame's features are worth, and how points are seen.

``lens`` is fx, fy, cx, cy throughout.
"""

from __future__ import annotations

import numpy as np

from slam_core.runtime.in_place import in_place

LEAST_DEPTH = 1e-3
"""Depths are kept away from zero, m."""


@in_place(error_model="numpy")
def measured(uv, depth, sigma_uv, sigma_depth, index, least_px, least_depth, z, variance):  # type: ignore[no-untyped-def]
    """Fill z and variance (k, 3) of the float32 features ``index`` (k,), with floors on their standard deviations."""
    for k in range(len(index)):
        n = index[k]
        d = np.float64(depth[n])
        z[k, 0], z[k, 1], z[k, 2] = uv[n, 0], uv[n, 1], 1.0 / d
        sigma_w = max(np.float64(sigma_depth[n]), least_depth) / (d * d)
        variance[k, 0] = max(np.float64(sigma_uv[n, 0]), least_px) ** 2
        variance[k, 1] = max(np.float64(sigma_uv[n, 1]), least_px) ** 2
        variance[k, 2] = sigma_w**2


@in_place(error_model="numpy")
def observed(points, T, centre, lens, z, depth, J_pose, J_point):  # type: ignore[no-untyped-def]
    """Fill z (n, 3), depth (n,), J_pose (n, 3, 6), J_point (n, 3, 3) of points (n, 3) seen by a camera at T (4, 4).

    ``centre`` (3,) is the place around which the rotation error of the pose turns.
    """
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - T[0, 3], points[n, 1] - T[1, 3], points[n, 2] - T[2, 3]
        x = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz
        y = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz
        depth[n] = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz
        w = 1.0 / (depth[n] if depth[n] > LEAST_DEPTH else LEAST_DEPTH)
        z[n, 0], z[n, 1], z[n, 2] = lens[0] * x * w + lens[2], lens[1] * y * w + lens[3], w
        ax, ay, az = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        for i in range(3):
            # Row i of the projection's derivative has an entry for its own coordinate and one for the depth.
            own = lens[i] * w if i < 2 else 0.0
            along = -lens[0] * x * w * w if i == 0 else (-lens[1] * y * w * w if i == 1 else -w * w)
            k = i if i < 2 else 2
            a = own * T[0, k] + along * T[0, 2]
            b = own * T[1, k] + along * T[1, 2]
            c = own * T[2, k] + along * T[2, 2]
            J_point[n, i, 0], J_point[n, i, 1], J_point[n, i, 2] = a, b, c
            J_pose[n, i, 0], J_pose[n, i, 1], J_pose[n, i, 2] = -a, -b, -c
            # Row times the cross product matrix of the arm.
            J_pose[n, i, 3], J_pose[n, i, 4], J_pose[n, i, 5] = b * az - c * ay, c * ax - a * az, a * ay - b * ax


@in_place(error_model="numpy")
def rolling_rates(z, lens, height, turn, shift, rates):  # type: ignore[no-untyped-def]
    """Fill rates (n, 3): m per second of readout by which points measured as z (n, 3) move in the optical frame.

    ``turn``, ``shift`` (3,): the camera's rotation and translation, rad/s and m/s, in the same frame.
    """
    for n in range(len(z)):
        depth = 1.0 / z[n, 2]
        x, y = (z[n, 0] - lens[2]) / lens[0] * depth, (z[n, 1] - lens[3]) / lens[1] * depth
        share = (z[n, 1] - 0.5 * (height - 1)) / height
        rates[n, 0] = share * (shift[0] + (turn[1] * depth - turn[2] * y))
        rates[n, 1] = share * (shift[1] + (turn[2] * x - turn[0] * depth))
        rates[n, 2] = share * (shift[2] + (turn[0] * y - turn[1] * x))


@in_place(error_model="numpy")
def moved_measurements(z, lens, rates, readout, moved):  # type: ignore[no-untyped-def]
    """Fill moved (n, 3): measurements of points measured as z (n, 3) after ``readout`` (s) at rates (n, 3) m/s."""
    for n in range(len(z)):
        depth = 1.0 / z[n, 2]
        x, y = (z[n, 0] - lens[2]) / lens[0] * depth, (z[n, 1] - lens[3]) / lens[1] * depth
        w = 1.0 / max(depth + readout * rates[n, 2], LEAST_DEPTH)
        moved[n, 0] = lens[0] * (x + readout * rates[n, 0]) * w + lens[2]
        moved[n, 1] = lens[1] * (y + readout * rates[n, 1]) * w + lens[3]
        moved[n, 2] = w


@in_place(error_model="numpy")
def placed(z, variance, T, lens, points, covariances):  # type: ignore[no-untyped-def]
    """Fill points (n, 3) and covariances (n, 3, 3) of measurements z of variance (n, 3) by a camera at T (4, 4)."""
    for n in range(len(z)):
        depth = 1.0 / z[n, 2]
        x, y = (z[n, 0] - lens[2]) / lens[0] * depth, (z[n, 1] - lens[3]) / lens[1] * depth
        su, sv, sw = variance[n, 0] * (depth / lens[0]) ** 2, variance[n, 1] * (depth / lens[1]) ** 2, variance[n, 2]
        for i in range(3):
            points[n, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * depth + T[i, 3]
        for i in range(3):
            along = (points[n, i] - T[i, 3]) * depth
            for j in range(i + 1):
                value = T[i, 0] * T[j, 0] * su + T[i, 1] * T[j, 1] * sv
                covariances[n, i, j] = value + along * (points[n, j] - T[j, 3]) * depth * sw
                covariances[n, j, i] = covariances[n, i, j]


@in_place(error_model="numpy")
def add_of_points(J, C, out):  # type: ignore[no-untyped-def]
    """``out[n] += J[n] C[n] J[n]'``, symmetric, for J, C and out (n, 3, 3)."""
    for n in range(len(J)):
        for i in range(3):
            a, b, c = J[n, i, 0], J[n, i, 1], J[n, i, 2]
            x = a * C[n, 0, 0] + b * C[n, 1, 0] + c * C[n, 2, 0]
            y = a * C[n, 1, 0] + b * C[n, 1, 1] + c * C[n, 2, 1]
            z = a * C[n, 2, 0] + b * C[n, 2, 1] + c * C[n, 2, 2]
            for j in range(i + 1):
                out[n, i, j] += x * J[n, j, 0] + y * J[n, j, 1] + z * J[n, j, 2]
                out[n, j, i] = out[n, i, j]


@in_place(error_model="numpy")
def add_of_pose(J, C, out):  # type: ignore[no-untyped-def]
    """``out[n] += J[n] C J[n]'``, symmetric, for J (n, 3, 6), C (6, 6) and out (n, 3, 3)."""
    for n in range(len(J)):
        for i in range(3):
            for j in range(i + 1):
                total = 0.0
                for a in range(6):
                    row = 0.0
                    for b in range(6):
                        row += C[a, b] * J[n, j, b]
                    total += J[n, i, a] * row
                out[n, i, j] += total
                out[n, j, i] = out[n, i, j]


@in_place(error_model="numpy")
def mixed_terms(J_pose, J_point, cross, rows, out):  # type: ignore[no-untyped-def]
    """``out[n] += A + A'`` with A = J_pose[n] C' J_point[n]', C the three rows of ``cross`` from rows[n] on."""
    for n in range(len(rows)):
        for i in range(3):
            for b in range(3):
                total = 0.0
                for a in range(6):
                    total += J_pose[n, i, a] * cross[rows[n] + b, a]
                for j in range(3):
                    out[n, i, j] += total * J_point[n, j, b]
                    out[n, j, i] += total * J_point[n, j, b]


@in_place(error_model="numpy")
def squared_lengths(innovation, S, out):  # type: ignore[no-untyped-def]
    """Fill out (n,) with the NIS of innovations (n, 3) with covariances S (n, 3, 3); NaN where S is not positive."""
    for n in range(len(out)):
        a = S[n, 0, 0] ** 0.5
        b, d = S[n, 1, 0] / a, S[n, 2, 0] / a
        c = (S[n, 1, 1] - b * b) ** 0.5
        e = (S[n, 2, 1] - d * b) / c
        f = (S[n, 2, 2] - d * d - e * e) ** 0.5
        x = innovation[n, 0] / a
        y = (innovation[n, 1] - b * x) / c
        w = (innovation[n, 2] - d * x - e * y) / f
        out[n] = x * x + y * y + w * w


@in_place(error_model="numpy")
def lower_innovation(J_pose, J_point, cross, rows, variance, common, S):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of ``S = H P H' + R + B C B'``, (3 m, 3 m) in Fortran order, from ``cross = P H'``.

    H: B = J_pose (m, 3, 6) at the state's head, J_point (m, 3, 3) at rows[k]. R: variance (m, 3). C: diagonal (6,), the
    variances ``common`` to all.
    """
    m = len(rows)
    for column in range(3 * m):
        p = cross[:, column]
        q, row = column // 3, column % 3
        own = J_pose[q, row]
        c0, c1, c2 = p[0] + common[0] * own[0], p[1] + common[1] * own[1], p[2] + common[2] * own[2]
        c3, c4, c5 = p[3] + common[3] * own[3], p[4] + common[4] * own[4], p[5] + common[5] * own[5]
        for k in range(q, m):
            r = rows[k]
            x, y, w = p[r], p[r + 1], p[r + 2]
            for i in range(3):
                a, b = J_pose[k, i], J_point[k, i]
                pose = a[0] * c0 + a[1] * c1 + a[2] * c2 + a[3] * c3 + a[4] * c4 + a[5] * c5
                S[3 * k + i, column] = pose + b[0] * x + b[1] * y + b[2] * w
        S[column, column] += variance[q, row]


@in_place()
def seen_from_rig(landmarks, blocks, T, head, first, points, covariances):  # type: ignore[no-untyped-def]
    """Fill points (m, 3) and covariances (m, 3, 3) of landmarks as a rig at T (4, 4) has them around itself.

    ``blocks`` (m, 3, 3) are the landmarks' own covariances, ``head`` (n, 6) those of the state with the pose; the
    landmarks' rows in it begin at ``first``.
    """
    for n in range(len(landmarks)):
        x, y, z = landmarks[n, 0] - T[0, 3], landmarks[n, 1] - T[1, 3], landmarks[n, 2] - T[2, 3]
        # With J = [-1, [arm]x]: rows of U are J P_pose J' / 2 + J P_pose,landmark, and C = block + U + U'.
        C, row = covariances[n], first + 3 * n
        for j in range(3):
            h = head[row + j]
            a, b, c = _relative(head, x, y, z, j)
            C[0, j] = 0.5 * a - h[0] + y * h[5] - z * h[4]
            C[1, j] = 0.5 * b - h[1] + z * h[3] - x * h[5]
            C[2, j] = 0.5 * c - h[2] + x * h[4] - y * h[3]
        for i in range(3):
            for j in range(i + 1):
                C[i, j] = C[i, j] + C[j, i] + blocks[n, i, j]
                C[j, i] = C[i, j]
        _turn_back(T, C)
        for i in range(3):
            points[n, i] = T[0, i] * x + T[1, i] * y + T[2, i] * z


@in_place()
def _relative(head, x, y, z, j):  # type: ignore[no-untyped-def]
    """Column j of J P_pose J' for J = [-1, [arm]x] of an arm x, y, z."""
    u, v, w = (0.0, -z, y) if j == 0 else ((z, 0.0, -x) if j == 1 else (-y, x, 0.0))
    p0 = u * head[0, 3] + v * head[0, 4] + w * head[0, 5] - head[0, j]
    p1 = u * head[1, 3] + v * head[1, 4] + w * head[1, 5] - head[1, j]
    p2 = u * head[2, 3] + v * head[2, 4] + w * head[2, 5] - head[2, j]
    p3 = u * head[3, 3] + v * head[3, 4] + w * head[3, 5] - head[3, j]
    p4 = u * head[4, 3] + v * head[4, 4] + w * head[4, 5] - head[4, j]
    p5 = u * head[5, 3] + v * head[5, 4] + w * head[5, 5] - head[5, j]
    return -p0 + y * p5 - z * p4, -p1 + z * p3 - x * p5, -p2 + x * p4 - y * p3


@in_place()
def _turn_back(T, C):  # type: ignore[no-untyped-def]
    """``C <- R' C R`` for the rotation R of T (4, 4) and a symmetric C (3, 3)."""
    a, b, c, d, e, f = C[0, 0], C[1, 0], C[1, 1], C[2, 0], C[2, 1], C[2, 2]
    for i in range(3):
        p, q, r = T[0, i], T[1, i], T[2, i]
        x, y, z = a * p + b * q + d * r, b * p + c * q + e * r, d * p + e * q + f * r
        for j in range(i + 1):
            C[i, j] = T[0, j] * x + T[1, j] * y + T[2, j] * z
            C[j, i] = C[i, j]


@in_place()
def moved_points(points, shift, turn, change, V, out):  # type: ignore[no-untyped-def]
    """By what (n, 3) a right-invariant error moves points (n, 3), given in plain coordinates.

    ``shift`` (n, 3) of the points, ``turn`` (3,), change = Exp(turn) - 1, V its left Jacobian.
    """
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a = shift[n, 0] - (turn[1] * z - turn[2] * y)
        b = shift[n, 1] - (turn[2] * x - turn[0] * z)
        c = shift[n, 2] - (turn[0] * y - turn[1] * x)
        for i in range(3):
            moved = change[i, 0] * x + change[i, 1] * y + change[i, 2] * z
            out[n, i] = moved + V[i, 0] * a + V[i, 1] * b + V[i, 2] * c
