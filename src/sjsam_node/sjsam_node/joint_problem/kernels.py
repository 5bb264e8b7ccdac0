# SPDX-License-Identifier: Apache-2.0
"""Compiled inner loops of the joining problem.

Residuals and normal equations of local maps, written for 2D and 3D alike.

A local map holds, in the frame of its reference pose ``(R_i, t_i)``, other poses and landmarks. Its measurement
function is ``h = R_i^T (l - t_i)`` for a landmark (Eq. 7.2) and ``(R_i^T (t_j - t_i), angle(R_i^T R_j))`` for a pose
(Eq. 7.3); the residual is ``h [-] z``. Poses move as in ``slam_core.geometry``: ``t + d[:d], Exp(d[d:]) R``.

``model`` says how an angle residual is measured: 0 planar (one wrapped angle), 1 rotation vector ``Log(R_h R_z^T)``,
2 difference of Euler angles yaw, pitch, roll, each wrapped. The local maps are stored flat, as
:class:`~sjsam_node.joint_problem.problem.FlatMaps`.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

from sjsam_node.joint_problem import angle_kernels
from sjsam_node.joint_problem.angle_kernels import angle_error, exp_rotation
from slam_core.linear_algebra.small_kernels import solved_square

PLANAR, TANGENT, EULER = angle_kernels.PLANAR, angle_kernels.TANGENT, angle_kernels.EULER


@njit(cache=True, nogil=True)
def local_residual(model, Ri, ti, poses, landmarks, z, R, t, points, r, B):
    """Residual ``r`` (m,) of one local map and the angle Jacobians ``B`` (poses, a, a)."""
    d = len(ti)
    a = 1 if d == 2 else 3
    Rh = np.empty((d, d))
    row = 0
    for k in range(len(poses)):
        j = poses[k]
        for p in range(d):
            value = -z[row + p]
            for q in range(d):
                value += Ri[q, p] * (t[j, q] - ti[q])
            r[row + p] = value
        for p in range(d):
            for q in range(d):
                value = 0.0
                for s in range(d):
                    value += Ri[s, p] * R[j, s, q]
                Rh[p, q] = value
        angle_error(model, Rh, z[row + d : row + d + a], r[row + d : row + d + a], B[k])
        row += d + a
    for k in range(len(landmarks)):
        j = landmarks[k]
        for p in range(d):
            value = -z[row + p]
            for q in range(d):
                value += Ri[q, p] * (points[j, q] - ti[q])
            r[row + p] = value
        row += d


@njit(cache=True, nogil=True)
def joint_cost(model, maps, R, t, points):
    """Sum of ``r^T information r + 2 pull^T r`` over all local maps."""
    ref, pose_ptr, pose_idx, lm_ptr, lm_idx, z_ptr, z, info_ptr, info, cost_gradient = maps
    total = 0.0
    d = t.shape[1]
    a = 1 if d == 2 else 3
    for f in range(len(ref)):
        m = z_ptr[f + 1] - z_ptr[f]
        r = np.empty(m)
        B = np.empty((pose_ptr[f + 1] - pose_ptr[f], a, a))
        local_residual(
            model, R[ref[f]], t[ref[f]], pose_idx[pose_ptr[f] : pose_ptr[f + 1]], lm_idx[lm_ptr[f] : lm_ptr[f + 1]],
            z[z_ptr[f] : z_ptr[f + 1]], R, t, points, r, B,
        )  # fmt: skip
        base = info_ptr[f]
        for i in range(m):
            row = 2.0 * cost_gradient[z_ptr[f] + i]
            for j in range(m):
                row += info[base + i * m + j] * r[j]
            total += r[i] * row
    return total


@njit(cache=True, nogil=True)
def joint_errors(model, maps, R, t, points, residual, weighted, nis):
    """Residuals of all local maps, ``information @ residual``, and the NIS of each landmark given the map's other rows.

    residual, weighted (m,) as the means lie; nis (l,) as the landmarks do, ``d`` degrees of freedom each.
    """
    ref, pose_ptr, pose_idx, lm_ptr, lm_idx, z_ptr, z, info_ptr, info, _ = maps
    d = t.shape[1]
    a = 1 if d == 2 else 3
    block = np.empty((d, d))
    for f in range(len(ref)):
        first, m = z_ptr[f], z_ptr[f + 1] - z_ptr[f]
        poses, landmarks = pose_idx[pose_ptr[f] : pose_ptr[f + 1]], lm_idx[lm_ptr[f] : lm_ptr[f + 1]]
        r, w = residual[first : first + m], weighted[first : first + m]
        B = np.empty((len(poses), a, a))
        local_residual(model, R[ref[f]], t[ref[f]], poses, landmarks, z[first : first + m], R, t, points, r, B)
        information = info[info_ptr[f] : info_ptr[f + 1]].reshape((m, m))
        w[:] = np.dot(information, r)
        for k in range(len(landmarks)):
            row = (d + a) * len(poses) + d * k
            block[:] = information[row : row + d, row : row + d]
            nis[lm_ptr[f] + k], _ = solved_square(block, w[row : row + d].copy())


@njit(cache=True, nogil=True)
def reference_jacobian(Ri, ti, poses, landmarks, t, points, B, J):
    """Columns of the reference pose, ``J`` (m, d + a): ``-R^T`` and ``R^T [l - t]x``, with ``-B R^T`` for angles."""
    d = len(ti)
    a = 1 if d == 2 else 3
    J[:] = 0.0
    v = np.empty(d)
    row = 0
    for k in range(len(poses) + len(landmarks)):
        is_pose = k < len(poses)
        for q in range(d):
            v[q] = (t[poses[k], q] if is_pose else points[landmarks[k - len(poses)], q]) - ti[q]
        for p in range(d):
            for q in range(d):
                J[row + p, q] = -Ri[q, p]
            if d == 2:
                J[row + p, 2] = Ri[0, p] * v[1] - Ri[1, p] * v[0]
            else:
                J[row + p, 3] = Ri[1, p] * v[2] - Ri[2, p] * v[1]
                J[row + p, 4] = Ri[2, p] * v[0] - Ri[0, p] * v[2]
                J[row + p, 5] = Ri[0, p] * v[1] - Ri[1, p] * v[0]
        row += d
        if is_pose:
            for p in range(a):
                for q in range(a):
                    J[row + p, d + q] = -_angle_column(B[k], Ri, p, q, a)
            row += a


@njit(cache=True, nogil=True, inline="always")
def _angle_column(B, Ri, p, q, a):
    """Entry (p, q) of ``B R_i^T``; in the plane rotations commute and it is ``B`` itself."""
    if a == 1:
        return B[0, 0]
    return B[p, 0] * Ri[q, 0] + B[p, 1] * Ri[q, 1] + B[p, 2] * Ri[q, 2]


@njit(cache=True, nogil=True)
def other_blocks(Ri, poses, landmarks, B, JB):
    """Diagonal blocks of the Jacobian for the measured poses and landmarks; ``JB`` (m, 3) row by row.

    Row i of JB holds the entries of row i inside its own block of width d (positions, landmarks) or a (angles).
    """
    d = Ri.shape[0]
    a = 1 if d == 2 else 3
    row = 0
    for k in range(len(poses) + len(landmarks)):
        for p in range(d):
            for q in range(d):
                JB[row + p, q] = Ri[q, p]
        row += d
        if k < len(poses):
            for p in range(a):
                for q in range(a):
                    JB[row + p, q] = _angle_column(B[k], Ri, p, q, a)
            row += a


@njit(cache=True, nogil=True)
def _block_starts(d, poses, landmarks):
    """First row and width of every diagonal block of one local map (a pose is two: position and angle)."""
    a = 1 if d == 2 else 3
    count = 2 * poses + landmarks
    start, width = np.empty(count, np.int64), np.empty(count, np.int64)
    row = 0
    for k in range(count):
        start[k] = row
        width[k] = a if k < 2 * poses and k % 2 == 1 else d
        row += width[k]
    return start, width


@njit(cache=True, nogil=True)
def _left_multiply(JB, start, width, A, out):
    """``out = JB^T A`` for block diagonal JB, row by row so that the inner loop is contiguous."""
    for b in range(len(start)):
        s, w = start[b], width[b]
        for q in range(w):
            if w == 3:
                x, y, z = JB[s, q], JB[s + 1, q], JB[s + 2, q]
                for c in range(A.shape[1]):
                    out[s + q, c] = x * A[s, c] + y * A[s + 1, c] + z * A[s + 2, c]
            elif w == 2:
                x, y = JB[s, q], JB[s + 1, q]
                for c in range(A.shape[1]):
                    out[s + q, c] = x * A[s, c] + y * A[s + 1, c]
            else:
                for c in range(A.shape[1]):
                    out[s, c] = JB[s, 0] * A[s, c]


@njit(cache=True, nogil=True)
def normal_equations(J, JB, start, width, info, r, cost_gradient, work, H, g):
    """Dense ``H = J^T info J``, ``g = J^T (info r + pull)`` of one local map over (reference pose, poses, landmarks).

    The part of J beyond the reference pose is block diagonal, so that H costs O(m^2), not O(m^3).
    """
    m, dp = J.shape
    half, turned = work[: m * m].reshape((m, m)), work[m * m : 2 * m * m].reshape((m, m))
    _left_multiply(JB, start, width, info, half)
    for i in range(m):
        for j in range(m):
            turned[j, i] = half[i, j]
    _left_multiply(JB, start, width, turned, half)
    weighted = info @ J
    flat = info @ r + cost_gradient
    whitened = flat.reshape((m, 1))
    mixed, moved = np.empty((m, dp)), np.empty((m, 1))
    _left_multiply(JB, start, width, weighted, mixed)
    _left_multiply(JB, start, width, whitened, moved)
    H[:dp, :dp] = J.T @ weighted
    H[dp:, :dp] = mixed
    H[:dp, dp:] = mixed.T
    H[dp:, dp:] = half
    g[:dp] = J.T @ flat
    g[dp:] = moved[:, 0]


@njit(cache=True, nogil=True)
def local_normal_equations(model, f, maps, R, t, points, work):
    """H (n, n) and g (n,) of local map ``f`` at the given state; ``work`` as :func:`work_space` makes it."""
    ref, pose_ptr, pose_idx, lm_ptr, lm_idx, z_ptr, z, info_ptr, info, cost_gradient = maps
    d = t.shape[1]
    a = 1 if d == 2 else 3
    m = z_ptr[f + 1] - z_ptr[f]
    poses, landmarks = pose_idx[pose_ptr[f] : pose_ptr[f + 1]], lm_idx[lm_ptr[f] : lm_ptr[f + 1]]
    Ri, ti = R[ref[f]], t[ref[f]]
    r, B = np.empty(m), np.empty((len(poses), a, a))
    local_residual(model, Ri, ti, poses, landmarks, z[z_ptr[f] : z_ptr[f + 1]], R, t, points, r, B)
    J, JB = np.empty((m, d + a)), np.zeros((m, 3))
    reference_jacobian(Ri, ti, poses, landmarks, t, points, B, J)
    other_blocks(Ri, poses, landmarks, B, JB)
    start, width = _block_starts(d, len(poses), len(landmarks))
    n = d + a + m
    H, g = work[2 * m * m : 2 * m * m + n * n].reshape((n, n)), np.empty(n)
    matrix = info[info_ptr[f] : info_ptr[f + 1]].reshape((m, m))
    normal_equations(J, JB, start, width, matrix, r, cost_gradient[z_ptr[f] : z_ptr[f + 1]], work, H, g)
    return H, g


@njit(cache=True, nogil=True)
def joint_gradient(model, maps, R, t, points, scatter, gradient):
    """Add ``J^T (information r + pull)`` of every local map."""
    ref, pose_ptr, pose_idx, lm_ptr, lm_idx, z_ptr, z, info_ptr, info, cost_gradient = maps
    item_ptr, item_group, item_offset, item_width, group_ptr, group_start = scatter[:6]
    d = t.shape[1]
    a = 1 if d == 2 else 3
    for f in range(len(ref)):
        m = z_ptr[f + 1] - z_ptr[f]
        poses, landmarks = pose_idx[pose_ptr[f] : pose_ptr[f + 1]], lm_idx[lm_ptr[f] : lm_ptr[f + 1]]
        r, B = np.empty(m), np.empty((len(poses), a, a))
        local_residual(model, R[ref[f]], t[ref[f]], poses, landmarks, z[z_ptr[f] : z_ptr[f + 1]], R, t, points, r, B)
        J, JB = np.empty((m, d + a)), np.zeros((m, 3))
        reference_jacobian(R[ref[f]], t[ref[f]], poses, landmarks, t, points, B, J)
        other_blocks(R[ref[f]], poses, landmarks, B, JB)
        start, width = _block_starts(d, len(poses), len(landmarks))
        flat, g = np.dot(info[info_ptr[f] : info_ptr[f + 1]].reshape((m, m)), r), np.empty(d + a + m)
        flat += cost_gradient[z_ptr[f] : z_ptr[f + 1]]
        _left_multiply(JB, start, width, flat.reshape((m, 1)), g[d + a :].reshape((m, 1)))
        g[: d + a] = np.dot(J.T, flat)
        row = 0
        for i in range(item_ptr[f], item_ptr[f + 1]):
            at = group_start[group_ptr[f] + item_group[i]]
            if at >= 0:
                for p in range(item_width[i]):
                    gradient[at + item_offset[i] + p] += g[row + p]
            row += item_width[i]


@njit(cache=True, nogil=True)
def work_space(maps):
    """Memory for the largest local map, so that none is asked for inside the loop."""
    largest = 0
    for f in range(len(maps[0])):
        largest = max(largest, maps[5][f + 1] - maps[5][f])
    return np.empty(2 * largest * largest + (largest + 6) * (largest + 6))


@njit(cache=True, nogil=True)
def joint_linearize(model, maps, R, t, points, scatter, values, gradient):
    """Add the normal equations of every local map to the sparse ones; ``scatter`` (``layout.Scatter``) says where."""
    work = work_space(maps)
    for f in range(len(maps[0])):
        H, g = local_normal_equations(model, f, maps, R, t, points, work)
        scatter_dense(f, H, g, scatter, values, gradient)


@njit(cache=True, nogil=True)
def scatter_dense(f, H, g, scatter, values, gradient):
    """Add dense symmetric normal equations over the items of map ``f`` to the sparse ones."""
    item_ptr, item_group, item_offset, item_width, group_ptr, group_start, pair_ptr, position, stride, swapped = scatter
    row = 0
    for i in range(item_ptr[f], item_ptr[f + 1]):
        gi, oi, height = item_group[i], item_offset[i], item_width[i]
        start = group_start[group_ptr[f] + gi]
        if start >= 0:
            for p in range(height):
                gradient[start + oi + p] += g[row + p]
        column = 0
        for j in range(item_ptr[f], i + 1):
            gj, oj, width = item_group[j], item_offset[j], item_width[j]
            low, high = min(gi, gj), max(gi, gj)
            pair = pair_ptr[f] + high * (high + 1) // 2 + low
            first, step = position[pair], stride[pair]
            # Rows of the stored block belong to the group that is eliminated later.
            if first >= 0 and ((gi > gj) != (swapped[pair] != 0) if gi != gj else oi >= oj):
                first += oj * step + oi
                for q in range(width):
                    for p in range(height):
                        values[first + q * step + p] += H[column + q, row + p]
            elif first >= 0:
                first += oi * step + oj
                for p in range(height):
                    for q in range(width):
                        values[first + p * step + q] += H[row + p, column + q]
            column += width
        row += height


@njit(cache=True, nogil=True)
def retract(R, t, points, pose_offset, landmark_offset, step, R_out, t_out, points_out):
    """JoiningState moved by ``step``; an offset of -1 stays."""
    d = t.shape[1]
    a = 1 if d == 2 else 3
    E = np.empty((d, d))
    for i in range(len(t)):
        o = pose_offset[i]
        if o < 0:
            R_out[i], t_out[i] = R[i], t[i]
            continue
        exp_rotation(step[o + d : o + d + a], E)
        R_out[i] = E @ R[i]
        for p in range(d):
            t_out[i, p] = t[i, p] + step[o + p]
    for i in range(len(points)):
        o = landmark_offset[i]
        for p in range(d):
            points_out[i, p] = points[i, p] + (step[o + p] if o >= 0 else 0.0)
