# SPDX-License-Identifier: Apache-2.0
"""Poses and motions of a sensor as poses and motions of the rig that carries it, and the velocity of a motion."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import (
    FloatArray,
    compose_jacobians,
    invert_transform,
    skew,
    so3_left_jacobian_inverse,
    so3_log,
)
from slam_core.types import PoseEstimate, RelativeMotion


def motion_of_rig(motion: RelativeMotion, T_rig_sensor: FloatArray) -> RelativeMotion:
    """``T_rig(start)_rig(end)`` of the sensor's own motion, with its covariance."""
    T, covariance = _conjugate(motion.T, motion.covariance, T_rig_sensor)
    return RelativeMotion(motion.start_stamp_ns, motion.end_stamp_ns, T, covariance)


def pose_of_rig(pose: PoseEstimate, T_rig_sensor: FloatArray) -> PoseEstimate:
    """``T_odom_rig`` of the sensor's pose in the frame of its first scan; the rig's first pose is the new origin."""
    return PoseEstimate(pose.stamp_ns, *_conjugate(pose.T, pose.covariance, T_rig_sensor))


def mean_twist(motion: RelativeMotion) -> tuple[FloatArray, FloatArray]:
    """Constant velocity (6,) of the motion, linear m/s and angular rad/s along the rig's axes, and covariance (6, 6).

    With ``T`` = (R, t) in a time dt: w = Log(R) / dt and v = J_l(w dt)^-1 t / dt; in the covariance, v's dependence on
    the angle is that of the first order. ValueError if no time has passed.
    """
    seconds = (motion.end_stamp_ns - motion.start_stamp_ns) * 1e-9
    if seconds <= 0.0:
        raise ValueError(f"a motion must take time to have a velocity, got {seconds} s")
    angle, t = so3_log(motion.T[:3, :3]), motion.T[:3, 3]
    V = so3_left_jacobian_inverse(angle)
    J = np.block([[V, 0.5 * skew(t) @ V], [np.zeros((3, 3)), V]])
    return np.concatenate([V @ t, angle]) / seconds, np.asarray(J @ motion.covariance @ J.T) / seconds**2


def _conjugate(T: FloatArray, covariance: FloatArray, T_rig_sensor: FloatArray) -> tuple[FloatArray, FloatArray]:
    T_sensor_rig = invert_transform(T_rig_sensor)
    onward = T @ T_sensor_rig
    J = compose_jacobians(T_rig_sensor, onward)[1] @ compose_jacobians(T, T_sensor_rig)[0]
    return T_rig_sensor @ onward, np.asarray(J @ covariance @ J.T)
