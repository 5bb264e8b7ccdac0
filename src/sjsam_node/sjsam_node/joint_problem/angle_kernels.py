# SPDX-License-Identifier: Apache-2.0
"""Compiled rotations of the joining problem: exponential, logarithm, and the error of a measured angle.

``model`` says how an angle residual is measured: 0 planar (one wrapped angle), 1 rotation vector ``Log(R_h R_z^T)``,
2 difference of Euler angles yaw, pitch, roll, each wrapped.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np
from numba import njit

PLANAR, TANGENT, EULER = 0, 1, 2


@njit(cache=True, nogil=True, inline="always")
def _wrap(angle):
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@njit(cache=True, nogil=True)
def exp_rotation(v, out):
    """Rodrigues' formula for a rotation vector (3,), or a planar angle (1,)."""
    if len(v) == 1:
        c, s = math.cos(v[0]), math.sin(v[0])
        out[0, 0], out[0, 1], out[1, 0], out[1, 1] = c, -s, s, c
        return
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if angle < 1e-7:
        a, b = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    x, y, z = v[0], v[1], v[2]
    out[0, 0], out[1, 1], out[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    out[0, 1], out[0, 2], out[1, 2] = b * x * y - a * z, b * x * z + a * y, b * y * z - a * x
    out[1, 0], out[2, 0], out[2, 1] = b * x * y + a * z, b * x * z - a * y, b * y * z + a * x


@njit(cache=True, nogil=True)
def _log(R, out):
    """Rotation vector of R, through the quaternion so that it holds up to and at pi."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    big = 3
    best = trace
    for i in range(3):
        if R[i, i] > best:
            big, best = i, R[i, i]
    if big == 3:
        q[0], q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        i, j, k = big, (big + 1) % 3, (big + 2) % 3
        q[i] = 1.0 - trace + 2.0 * R[i, i]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    imaginary = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    norm = math.copysign(math.sqrt(imaginary + q[3] * q[3]), q[3])
    sine, cosine = math.sqrt(imaginary) / abs(norm), q[3] / norm
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, cosine) / sine
    for i in range(3):
        out[i] = scale * q[i] / norm


@njit(cache=True, nogil=True)
def angle_error(model, Rh, z, r, B):
    """Angle residual ``r`` of the relative rotation ``Rh`` against ``z``, and ``B`` = d r / d(left rotation of Rh)."""
    if model == PLANAR:
        r[0] = _wrap(math.atan2(Rh[1, 0], Rh[0, 0]) - z[0])
        B[0, 0] = 1.0
        return
    if model == TANGENT:
        Rz, R = np.empty((3, 3)), np.empty((3, 3))
        exp_rotation(z, Rz)
        for i in range(3):
            for j in range(3):
                R[i, j] = Rh[i, 0] * Rz[j, 0] + Rh[i, 1] * Rz[j, 1] + Rh[i, 2] * Rz[j, 2]
        _log(R, r)
        angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        b = 1.0 / 12.0 + angle * angle / 720.0
        if angle > 1e-3:
            b = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / (angle * angle)
        sq = angle * angle
        for i in range(3):
            for j in range(3):
                B[i, j] = b * r[i] * r[j]
            B[i, i] += 1.0 - b * sq
        B[0, 1] += 0.5 * r[2]
        B[0, 2] -= 0.5 * r[1]
        B[1, 0] -= 0.5 * r[2]
        B[1, 2] += 0.5 * r[0]
        B[2, 0] += 0.5 * r[1]
        B[2, 1] -= 0.5 * r[0]
        return
    yaw = math.atan2(Rh[1, 0], Rh[0, 0])
    pitch = math.asin(min(1.0, max(-1.0, -Rh[2, 0])))
    roll = math.atan2(Rh[2, 1], Rh[2, 2])
    # The same rotation has a second triple, beyond a pitch of 90 deg; a measured one with noise may lie there.
    first = abs(_wrap(yaw - z[0])) + abs(_wrap(pitch - z[1])) + abs(_wrap(roll - z[2]))
    beyond = math.pi - pitch
    second = abs(_wrap(yaw + math.pi - z[0])) + abs(_wrap(beyond - z[1])) + abs(_wrap(roll + math.pi - z[2]))
    if second < first:
        yaw, pitch, roll = yaw + math.pi, beyond, roll + math.pi
    r[0], r[1], r[2] = _wrap(yaw - z[0]), _wrap(pitch - z[1]), _wrap(roll - z[2])
    # Inverse of the map from Euler rates to the angular velocity in the reference frame; singular at pitch = 90 deg.
    c, s, cp = math.cos(yaw), math.sin(yaw), math.cos(pitch)
    cp = math.copysign(max(abs(cp), 1e-9), cp)
    tp = math.sin(pitch) / cp
    B[0, 0], B[0, 1], B[0, 2] = c * tp, s * tp, 1.0
    B[1, 0], B[1, 1], B[1, 2] = -s, c, 0.0
    B[2, 0], B[2, 1], B[2, 2] = c / cp, s / cp, 0.0
