# SPDX-License-Identifier: Apache-2.0
"""A rig that is carried about by hand, and what an IMU on it reads."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import FloatArray, make_transform, rotation_from_euler, so3_exp, so3_log
from slam_core.types import ImuSample

RATE = 100.0
_STEP = 1e-3
PLACE = np.array([0.05, -0.03, 0.1])
GYRO_BIAS = np.array([0.01, -0.02, 0.005])
ACCELEROMETER_BIAS = np.array([0.06, -0.04, 0.08])


def carried(t: float) -> FloatArray:
    """Pose T_world_rig at time t (s): once round a circle of 1.5 m in 8 s, looking outwards, with a hand's unrest."""
    angle = 2.0 * np.pi * t / 8.0
    sway = 0.02 * np.array([np.sin(5.1 * t), np.cos(6.3 * t), np.sin(9.7 * t)])
    tilt = 0.04 * np.array([np.sin(4.3 * t), np.sin(3.1 * t + 1.0), np.sin(2.7 * t + 2.0)])
    place = 1.5 * np.array([np.cos(angle), np.sin(angle), 0.0]) + sway
    return make_transform(rotation_from_euler(angle + 0.3) @ so3_exp(tilt), place)


def velocity(t: float) -> FloatArray:
    """Of the IMU's place along the rig's axes, (3,) m/s."""
    before, after = (imu_place(t + s) for s in (-_STEP, _STEP))
    return np.asarray(carried(t)[:3, :3].T @ (after - before) / (2.0 * _STEP))


def imu_place(t: float) -> FloatArray:
    """Where the IMU is in the world, (3,) m."""
    T = carried(t)
    return np.asarray(T[:3, :3] @ PLACE + T[:3, 3])


def readings(
    seconds: float, rng: np.random.Generator, gyro_noise: float = 3e-4, accelerometer_noise: float = 3e-3
) -> list[ImuSample]:
    """What the IMU reads from 10 ms before the start on; noises per root of Hz."""
    samples = []
    for k in range(-1, int(seconds * RATE) + 2):
        t = k / RATE
        R = carried(t)[:3, :3]
        turn = so3_log(carried(t - _STEP)[:3, :3].T @ carried(t + _STEP)[:3, :3]) / (2.0 * _STEP)
        force = (imu_place(t + _STEP) - 2.0 * imu_place(t) + imu_place(t - _STEP)) / _STEP**2 + [0.0, 0.0, 9.81]
        turn = turn + GYRO_BIAS + gyro_noise * np.sqrt(RATE) * rng.standard_normal(3)
        force = R.T @ force + ACCELEROMETER_BIAS + accelerometer_noise * np.sqrt(RATE) * rng.standard_normal(3)
        samples.append(ImuSample(round(t * 1e9), turn, force, position=PLACE))
    return samples
