# SPDX-License-Identifier: Apache-2.0
"""Jacobians of the models against central differences, and inverses against their originals."""

from __future__ import annotations

import numpy as np
import pytest

from ekf_slam_node.filtering import models
from feature_world import CAMERA, T_RIG_OPTICAL
from slam_core.geometry import (
    FloatArray,
    boxminus,
    boxplus,
    make_transform,
    so3_exp,
    transform_points,
)

STEP = 1e-6


@pytest.fixture(params=range(4))
def state(request: pytest.FixtureRequest) -> tuple[FloatArray, FloatArray]:
    """A pose and body velocities; the last ones turn fast."""
    rng = np.random.default_rng(request.param)
    T = make_transform(so3_exp(rng.standard_normal(3)), rng.standard_normal(3))
    return T, rng.standard_normal(6) * (1.0 + request.param)


def numeric(function, size: int) -> FloatArray:  # type: ignore[no-untyped-def]
    columns = [(function(step) - function(-step)) / (2 * STEP) for step in STEP * np.eye(size)]
    return np.stack(columns, axis=-1)


def advance(T: FloatArray, velocity: FloatArray, dt: float, delta: FloatArray, noise: FloatArray) -> FloatArray:
    """Error coordinates after the motion, relative to the undisturbed one."""
    moved_T, moved_velocity = boxplus(T, delta[:6]), velocity + delta[6:]
    end = moved_T @ models.relative_motion(moved_velocity + 0.5 * dt * noise, dt)
    reference = T @ models.relative_motion(velocity, dt)
    return np.concatenate([boxminus(end, reference), delta[6:] + dt * noise])


@pytest.mark.parametrize("dt", [0.05, 0.7])
def test_motion_jacobians(state: tuple[FloatArray, FloatArray], dt: float) -> None:
    T, velocity = state
    F = numeric(lambda d: advance(T, velocity, dt, d, np.zeros(6)), 12)
    G = numeric(lambda a: advance(T, velocity, dt, np.zeros(12), a), 6)
    np.testing.assert_allclose(models.motion_jacobian(T, velocity, dt), F, atol=2e-8)
    np.testing.assert_allclose(models.noise_gain(T[:3, :3], velocity, dt), G, atol=2e-8)


def test_velocity_of_motion_inverts(state: tuple[FloatArray, FloatArray]) -> None:
    velocity = 0.3 * state[1]
    np.testing.assert_allclose(
        models.velocity_of_motion(models.relative_motion(velocity, 0.4), 0.4), velocity, atol=1e-12
    )


@pytest.fixture
def mounting() -> FloatArray:
    """A camera that is neither at the rig's origin nor along its axis."""
    return T_RIG_OPTICAL @ make_transform(so3_exp(np.array([0.1, -0.2, 0.05])), np.array([0.05, -0.1, 0.2]))


def test_observation_jacobians(mounting: FloatArray, rng: np.random.Generator) -> None:
    T = make_transform(so3_exp(rng.standard_normal(3)), rng.standard_normal(3))
    optical = np.column_stack([rng.uniform(-2, 2, 5), rng.uniform(-1, 1, 5), rng.uniform(1, 9, 5)])
    points = transform_points(T @ mounting, optical)
    seen = models.observe(T, mounting, points, CAMERA)
    by_pose = numeric(lambda d: models.observe(boxplus(T, d), mounting, points, CAMERA).z, 6)
    by_point = numeric(lambda d: models.observe(T, mounting, points + d, CAMERA).z, 3)
    np.testing.assert_allclose(seen.J_pose, by_pose, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(seen.J_point, by_point, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(seen.z[:, :2], CAMERA.project(optical), atol=1e-9)
    assert seen.in_image(CAMERA).tolist() == [bool(0 <= u <= 639 and 0 <= v <= 479) for u, v in seen.z[:, :2]]


def test_back_projection_inverts_and_differentiates(rng: np.random.Generator) -> None:
    z = np.column_stack([rng.uniform(0, 640, 6), rng.uniform(0, 480, 6), rng.uniform(0.1, 1.0, 6)])
    np.testing.assert_allclose(models.project(models.back_project(z, CAMERA), CAMERA), z, rtol=1e-12)
    J = numeric(lambda d: models.back_project(z + d, CAMERA), 3)
    frame = models.Frame(
        0, z, rng.uniform(0.1, 1.0, (6, 3)), np.zeros((6, 1)), CAMERA, np.arange(6), np.zeros(6, np.int32)
    )
    covariances = models.rig_points(frame, np.eye(4))[1]
    np.testing.assert_allclose(covariances, np.einsum("nij,nj,nkj->nik", J, frame.variance, J), rtol=1e-6, atol=1e-7)


def test_points_behind_the_camera_are_not_in_the_image(mounting: FloatArray) -> None:
    T = np.eye(4)
    behind = transform_points(mounting, np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]]))
    assert models.observe(T, mounting, behind, CAMERA).in_image(CAMERA).tolist() == [False, True]
    assert np.isfinite(models.observe(T, mounting, behind, CAMERA).z).all()
