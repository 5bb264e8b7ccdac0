# SPDX-License-Identifier: Apache-2.0
"""A rig that is carried along its own axes by a known way: its covariance against samples of its errors."""

from __future__ import annotations

import numpy as np

from ekf_slam_node.filtering.ekf import Ekf
from slam_core.geometry import boxminus, boxplus, make_transform, rotation_from_euler


def test_the_way_turns_with_the_error_of_the_orientation() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(15, 15))
    sigma = np.concatenate([np.full(3, 0.02), np.full(3, 0.01), np.full(6, 0.1), np.full(3, 0.03)])
    covariance = np.diag(sigma) @ (A @ A.T / 15.0 + 0.3 * np.eye(15)) @ np.diag(sigma)
    ekf = Ekf(np.zeros(6), covariance, landmarks=np.array([[2.0, 0.5, 0.1]]))
    ekf.T = make_transform(rotation_from_euler(0.7, 0.2), np.array([1.0, 2.0, 0.3]))
    start, up_rig = ekf.T.copy(), np.array([0.1, -0.2, 9.0])
    noise = np.diag([0.01, 0.02, 0.1]) ** 2
    ekf.displace(start[:3, :3] @ up_rig, noise)
    errors = []
    for delta in rng.multivariate_normal(np.zeros(15), covariance, 20000):
        true = boxplus(start, delta[:6])
        true[:3, 3] += true[:3, :3] @ up_rig + np.sqrt(np.diag(noise)) * rng.standard_normal(3)
        errors.append(np.concatenate([boxminus(true, ekf.T), delta[6:]]))
    sampled = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    np.testing.assert_allclose(ekf.covariance.dense(np.arange(15)) / scale, sampled / scale, atol=0.04)
    np.testing.assert_array_equal(ekf.landmarks, [[2.0, 0.5, 0.1]])
    assert np.linalg.eigvalsh(ekf.covariance.dense(np.arange(15)))[0] > 0.0
