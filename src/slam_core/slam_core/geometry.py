# SPDX-License-Identifier: Apache-2.0
"""Rotations, rigid transforms and how uncertainty travels through them.

Conventions, used by every package:

- A transform ``T_target_source`` is a float64 array, shape (4, 4); it maps coordinates in ``source`` to ``target``.
- A pose error is a 6-vector, **translation first**: ``T [+] d = (t + d[:3], Exp(d[3:]) R)``. Both halves are expressed
  along the axes of the *target* (parent) frame, so a 6x6 covariance is exactly the one that
  ``geometry_msgs/PoseWithCovariance`` asks for: x, y, z, then rotations about the fixed axes X, Y, Z.
- Quaternions are x, y, z, w, unit norm, w >= 0 where a sign must be chosen.
- Euler angles (yaw, pitch, roll) appear in reports only (thesis Eqs. 5.11-5.13).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

OPTICAL_FROM_RIG: FloatArray = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation from the rig (X forward, Y left, Z up) to an optical frame (x right, y down, z forward), Eq. 5.17."""

_SMALL_ANGLE = 1e-7


def skew(v: FloatArray) -> FloatArray:
    """Cross-product matrix ``[v]x``: ``skew(a) @ b == cross(a, b)``; shape (..., 3) to (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    if v.ndim == 1:
        x, y, z = v.tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(phi: FloatArray) -> FloatArray:
    """Rotation of a rotation vector (Rodrigues); shape (..., 3) rad to (..., 3, 3)."""
    phi = np.asarray(phi, dtype=np.float64)
    if phi.ndim == 1:
        return _exp_of_one(*phi.tolist())
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    K = skew(phi)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def _exp_of_one(x: float, y: float, z: float) -> FloatArray:
    """:func:`so3_exp` of one vector, a tenth of the time of arrays of one."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < _SMALL_ANGLE:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    elif math.isfinite(angle):
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        a = b = math.nan
    return _turn(a, b, x, y, z)


def _turn(a: float, b: float, x: float, y: float, z: float) -> FloatArray:
    """``I + a [v]x + b [v]x^2`` of v = (x, y, z)."""
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def so3_log(rotation: FloatArray) -> FloatArray:
    """Rotation vector of a rotation, angle in [0, pi]; shape (..., 3, 3) to (..., 3) rad. Exact up to and at pi."""
    q = quaternion_from_rotation(rotation)
    if q.ndim == 1:
        return _log_of_one(*q.tolist())
    norm = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, q[..., 3:])
    small = norm < _SMALL_ANGLE
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, norm))
    return np.asarray(scale * q[..., :3])


def _log_of_one(x: float, y: float, z: float, w: float) -> FloatArray:
    """Rotation vector of a quaternion, a tenth of the time of arrays of one."""
    norm = math.hypot(x, y, z)
    scale = 2.0 if norm < _SMALL_ANGLE else 2.0 * math.atan2(norm, w) / norm
    return np.array([scale * x, scale * y, scale * z])


def so3_left_jacobian(phi: FloatArray) -> FloatArray:
    """``J`` with ``Exp(phi + d) ~ Exp(J d) Exp(phi)``; shape (..., 3) to (..., 3, 3)."""
    phi = np.asarray(phi, dtype=np.float64)
    if phi.ndim == 1:
        return _left_jacobian_of_one(*phi.tolist())
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    K = skew(phi)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def _left_jacobian_of_one(x: float, y: float, z: float) -> FloatArray:
    """:func:`so3_left_jacobian` of one vector, a tenth of the time of arrays of one."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < 1e-4:
        a, b = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    elif math.isfinite(angle):
        a, b = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (angle * square)
    else:
        a = b = math.nan
    return _turn(a, b, x, y, z)


def so3_left_jacobian_inverse(phi: FloatArray) -> FloatArray:
    """Inverse of :func:`so3_left_jacobian`, valid for angles below 2 pi."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    half = 0.5 * safe
    b = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half / np.tan(half)) / safe**2)
    K = skew(phi)
    return np.asarray(np.eye(3) - 0.5 * K + b * (K @ K))


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation; shape (..., 3, 3) to (..., 4) (Shepperd's method)."""
    R = np.asarray(rotation, dtype=np.float64)
    if R.ndim == 2:
        return _quaternion_of_one(R.tolist())
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    candidates = np.stack([R[..., 0, 0], R[..., 1, 1], R[..., 2, 2], trace], axis=-1)
    which = np.argmax(candidates, axis=-1)
    q = np.empty((*R.shape[:-2], 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        m = which == i
        q[m, i] = 1.0 - trace[m] + 2.0 * R[m, i, i]
        q[m, j] = R[m, j, i] + R[m, i, j]
        q[m, k] = R[m, k, i] + R[m, i, k]
        q[m, 3] = R[m, k, j] - R[m, j, k]
    m = which == 3
    q[m, 0] = R[m, 2, 1] - R[m, 1, 2]
    q[m, 1] = R[m, 0, 2] - R[m, 2, 0]
    q[m, 2] = R[m, 1, 0] - R[m, 0, 1]
    q[m, 3] = 1.0 + trace[m]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def _quaternion_of_one(R: list[list[float]]) -> FloatArray:
    """:func:`quaternion_from_rotation` of one rotation, a tenth of the time of arrays of one."""
    trace = R[0][0] + R[1][1] + R[2][2]
    diagonal = [R[0][0], R[1][1], R[2][2], trace]
    i = diagonal.index(max(diagonal))
    if i == 3:
        q = [R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1], 1.0 + trace]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [0.0, 0.0, 0.0, R[k][j] - R[j][k]]
        q[i], q[j], q[k] = 1.0 - trace + 2.0 * R[i][i], R[j][i] + R[i][j], R[k][i] + R[i][k]
    return np.array(q) / math.copysign(math.hypot(*q), q[3] if q[3] != 0.0 else 1.0)


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Rotation of a quaternion (x, y, z, w); shape (..., 4) to (..., 3, 3).

    Raises
    ------
    ValueError
        If the norm differs from one by more than 1 %: such a quaternion is a fault, not rounding.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    if q.ndim == 1:
        return np.array(_rows_of_rotation(*_unit_of_one(*q.tolist())))
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(norm - 1.0) < 0.01):
        raise ValueError(f"quaternion must have unit norm, got norm {norm.ravel()[:4]}")
    rows = _rows_of_rotation(*np.moveaxis(q / norm, -1, 0))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _unit_of_one(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """One quaternion of norm one, a tenth of the time of arrays of one."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not abs(norm - 1.0) < 0.01:
        raise ValueError(f"quaternion must have unit norm, got norm {norm}")
    return x / norm, y / norm, z / norm, w / norm


def _rows_of_rotation(x: Any, y: Any, z: Any, w: Any) -> list[list[Any]]:
    """Rotation of unit quaternions, row by row: numbers, or arrays of one shape."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def euler_from_rotation(rotation: FloatArray) -> FloatArray:
    """Yaw, pitch, roll (rad) of a rig-to-map rotation, ``R = Rz(yaw) Ry(pitch) Rx(roll)``; (..., 3, 3) to (..., 3)."""
    R = np.asarray(rotation, dtype=np.float64)
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    pitch = np.arcsin(np.clip(-R[..., 2, 0], -1.0, 1.0))
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    return np.stack([yaw, pitch, roll], axis=-1)


def rotation_from_euler(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> FloatArray:
    """Inverse of :func:`euler_from_rotation`; angles in rad."""
    return so3_exp(np.array([0, 0, yaw])) @ so3_exp(np.array([0, pitch, 0])) @ so3_exp(np.array([roll, 0, 0]))


def make_transform(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Homogeneous transforms, shape (..., 4, 4), of rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation), np.asarray(translation)
    T = np.zeros((*rotation.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def invert_transform(T: FloatArray) -> FloatArray:
    """Inverse of rigid transforms, shape (..., 4, 4)."""
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_transform(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def transform_points(T: FloatArray, points: FloatArray) -> FloatArray:
    """Map points, shape (n, 3), through one transform (4, 4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def transform_from_pose7(pose: FloatArray) -> FloatArray:
    """Transform of ``x y z qx qy qz qw``, shape (..., 7) to (..., 4, 4)."""
    pose = np.asarray(pose, dtype=np.float64)
    return make_transform(rotation_from_quaternion(pose[..., 3:]), pose[..., :3])


def pose7_from_transform(T: FloatArray) -> FloatArray:
    """``x y z qx qy qz qw`` of transforms, shape (..., 4, 4) to (..., 7)."""
    return np.concatenate([T[..., :3, 3], quaternion_from_rotation(T[..., :3, :3])], axis=-1)


def boxplus(T: FloatArray, delta: FloatArray) -> FloatArray:
    """``T [+] d = (t + d[:3], Exp(d[3:]) R)``; T (..., 4, 4), d (..., 6)."""
    delta = np.asarray(delta)
    return make_transform(so3_exp(delta[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + delta[..., :3])


def boxminus(T: FloatArray, reference: FloatArray) -> FloatArray:
    """``d`` with ``reference [+] d == T``; shape (..., 4, 4) to (..., 6)."""
    dR = T[..., :3, :3] @ np.swapaxes(reference[..., :3, :3], -1, -2)
    return np.concatenate([T[..., :3, 3] - reference[..., :3, 3], so3_log(dR)], axis=-1)


def both_halves(rotation: FloatArray) -> FloatArray:
    """(..., 6, 6) that turns translation and rotation of a pose error by the same rotation (..., 3, 3)."""
    R = np.zeros((*rotation.shape[:-2], 6, 6))
    R[..., :3, :3] = R[..., 3:, 3:] = rotation
    return R


def compose_jacobians(T_a_b: FloatArray, T_b_c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Jacobians (..., 6, 6) of ``T_a_b @ T_b_c`` with respect to the errors of its two factors, (..., 4, 4) each."""
    R = T_a_b[..., :3, :3]
    J_ab = np.zeros((*R.shape[:-2], 6, 6))
    J_ab[..., range(6), range(6)] = 1.0
    J_ab[..., :3, 3:] = -skew((R @ T_b_c[..., :3, 3:])[..., 0])
    return J_ab, both_halves(R)


def inverse_jacobian(T: FloatArray) -> FloatArray:
    """Jacobian (6, 6) of ``invert_transform(T)`` with respect to the error of ``T``."""
    Rt = T[:3, :3].T
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = -Rt
    J[:3, 3:] = -Rt @ skew(T[:3, 3])
    return J


def compose_covariance(
    T_a_b: FloatArray, covariance_ab: FloatArray, T_b_c: FloatArray, covariance_bc: FloatArray
) -> FloatArray:
    """Covariance (6, 6) of ``T_a_b @ T_b_c`` for independent factors, to first order."""
    J_ab, J_bc = compose_jacobians(T_a_b, T_b_c)
    return np.asarray(J_ab @ covariance_ab @ J_ab.T + J_bc @ covariance_bc @ J_bc.T)


def interpolate_transform(T0: FloatArray, T1: FloatArray, fraction: FloatArray) -> FloatArray:
    """Screw-free interpolation (translation linear, rotation geodesic); fraction (...,) in [0, 1]."""
    fraction = np.asarray(fraction, dtype=np.float64)[..., None]
    return boxplus(T0, fraction * boxminus(T1, T0))


def is_rigid_transform(T: FloatArray, tolerance: float = 1e-6) -> bool:
    """True if ``T`` is a finite (4, 4) matrix with a proper rotation and the last row 0 0 0 1."""
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        return False
    R = T[:3, :3]
    orthonormal = np.abs(R @ R.T - np.eye(3)).max() < tolerance
    return bool(orthonormal and np.linalg.det(R) > 0.0 and np.abs(T[3] - [0, 0, 0, 1]).max() < tolerance)
