# SPDX-License-Identifier: Apache-2.0
"""Motions of a sensor become motions of its rig; their covariances by Monte-Carlo."""

from __future__ import annotations

import numpy as np

from slam_core.geometry import boxminus, boxplus, invert_transform
from slam_core.motion import motion_of_rig
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
