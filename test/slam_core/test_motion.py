# SPDX-License-Identifier: Apache-2.0
"""Motions of a sensor become motions of its rig, and velocities; their covariances by Monte-Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from slam_core.geometry import boxminus, boxplus, invert_transform, so3_exp
from slam_core.motion import mean_twist, motion_of_rig
from slam_core.types import RelativeMotion


def test_motion_and_covariance_of_the_rig(rng):
    T_rig_sensor = boxplus(np.eye(4), np.array([0.3, -0.2, 0.5, 0.4, -1.0, 0.7]))
    T_rig = boxplus(np.eye(4), np.array([0.5, 0.1, -0.2, 0.1, 0.3, -0.6]))
    T_sensor = invert_transform(T_rig_sensor) @ T_rig @ T_rig_sensor
    A = rng.normal(size=(6, 6)) * 1e-3
    P = A @ A.T
    motion = motion_of_rig(RelativeMotion(1, 2, T_sensor, P), T_rig_sensor)
    np.testing.assert_allclose(motion.T, T_rig, atol=1e-12)
    samples = boxplus(T_sensor, rng.multivariate_normal(np.zeros(6), P, 20000))
    errors = boxminus(T_rig_sensor @ samples @ invert_transform(T_rig_sensor), T_rig)
    measured = errors.T @ errors / len(errors)
    scale = np.sqrt(np.outer(np.diag(P), np.diag(P))).max()
    np.testing.assert_allclose(motion.covariance, measured, atol=0.05 * max(scale, np.abs(measured).max()))


def test_velocity_and_covariance_of_a_motion(rng):
    T = boxplus(np.eye(4), np.array([0.05, 0.01, -0.02, 0.1, 0.3, -0.6]))
    A = rng.normal(size=(6, 6)) * 1e-3
    P = A @ A.T
    velocity, covariance = mean_twist(RelativeMotion(10**9, 10**9 + 2 * 10**8, T, P))
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = so3_exp(velocity[3:] * 2e-6), velocity[:3] * 2e-6
    np.testing.assert_allclose(np.linalg.matrix_power(step, 100_000), T, atol=1e-6)
    samples = boxplus(T, rng.multivariate_normal(np.zeros(6), P, 20000))
    twists = [mean_twist(RelativeMotion(0, 2 * 10**8, sample, P))[0] for sample in samples]
    measured = np.cov(np.array(twists).T)
    np.testing.assert_allclose(covariance, measured, atol=0.05 * np.abs(measured).max())
    with pytest.raises(ValueError, match="take time"):
        mean_twist(RelativeMotion(5, 5, T, P))
