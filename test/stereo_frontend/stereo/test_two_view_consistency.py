# SPDX-License-Identifier: Apache-2.0
"""Linearisation of the same points in two stereo pairs, against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.geometry import make_transform, so3_exp
from stereo_frontend.stereo.two_view_consistency import StereoView, _column_jacobian, _linearised

PAIR = StereoCamera(Camera(640, 480, 400.0, 410.0, 320.0, 240.0), 0.12)
N, STEP = 40, 1e-6


@pytest.fixture
def views(rng):
    def view():
        uv, noise = rng.uniform(50, 430, (N, 2)), rng.uniform(0.05, 0.4, (3, N))
        return StereoView(
            PAIR, np.zeros((N, 4), np.float32), uv, rng.uniform(4, 30, N), noise[0], np.zeros(N), noise[1], noise[2]
        )

    return view(), view()


@pytest.fixture
def state(rng):
    return make_transform(so3_exp(0.1 * rng.standard_normal(3)), 0.1 * rng.standard_normal(3)), 1e-3 * rng.normal(
        size=10
    )


def residual(views, T, theta, change=None):
    bases = _column_jacobian(views[0]), _column_jacobian(views[1])
    if change is not None:
        T = make_transform(so3_exp(change[3:6]) @ T[:3, :3], T[:3, 3] + change[:3])
        theta = theta + change[6:]
    return _linearised(*views, bases, T, theta)


def test_jacobians_are_those_of_central_differences(views, state):
    _, J, _, _ = residual(views, *state)
    for i, unit in enumerate(STEP * np.eye(16)):
        numeric = (residual(views, *state, unit)[0] - residual(views, *state, -unit)[0]) / (2.0 * STEP)
        np.testing.assert_allclose(J[:, :, i], numeric, rtol=1e-5, atol=1e-4)


def test_information_is_that_of_both_measurements(views, state):
    first, second = views
    error, _, information, squares = residual(views, *state)
    up, down = (replace(first, disparity=first.disparity + s) for s in (STEP, -STEP))
    bases = _column_jacobian(first), _column_jacobian(second)
    e = (_linearised(up, second, bases, *state)[0] - _linearised(down, second, bases, *state)[0]) / (2.0 * STEP)
    covariance = np.einsum("ni,nj,n->nij", e, e, first.sigma**2)
    pixel = first.sigma_uv**2 + second.sigma_uv**2
    covariance += np.einsum("kn,kij->nij", [pixel, pixel, second.sigma**2], [np.diag(row) for row in np.eye(3)])
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(squares, np.einsum("ni,nij,nj->n", error, information, error))
