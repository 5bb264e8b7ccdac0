# SPDX-License-Identifier: Apache-2.0
"""Lens functions: the same pixels as the camera models, derivatives as central differences."""

from __future__ import annotations

import numpy as np
import pytest

from slam_calibration.lens import DISTORTION_PARAMETERS, parameter_names, project_with_jacobians
from slam_simulation.calibration.board_views import example_camera


@pytest.mark.parametrize("lens", DISTORTION_PARAMETERS)
def test_pixels_are_the_camera_models(lens: str, rng: np.random.Generator) -> None:
    state = example_camera(lens)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (40, 2)), rng.uniform(0.8, 2.0, 40)])
    pixels, _, _ = project_with_jacobians(lens, state.parameters, points)
    np.testing.assert_allclose(pixels, state.camera.project(points), atol=1e-10)
    assert len(parameter_names(lens)) == len(state.parameters)


@pytest.mark.parametrize("lens", DISTORTION_PARAMETERS)
def test_jacobians_against_central_differences(lens: str, rng: np.random.Generator) -> None:
    parameters, step = example_camera(lens).parameters, 1e-6
    points = np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)), rng.uniform(0.8, 2.0, 20)])
    points[0] = [0.0, 0.0, 1.0]
    _, J_point, J_parameters = project_with_jacobians(lens, parameters, points)
    for i, e in enumerate(step * np.eye(3)):
        numeric = project_with_jacobians(lens, parameters, points + e)[0]
        numeric = (numeric - project_with_jacobians(lens, parameters, points - e)[0]) / (2 * step)
        np.testing.assert_allclose(J_point[:, :, i], numeric, atol=2e-6 * np.abs(J_point).max())
    for i, e in enumerate(step * np.eye(len(parameters))):
        numeric = project_with_jacobians(lens, parameters + e, points)[0]
        numeric = (numeric - project_with_jacobians(lens, parameters - e, points)[0]) / (2 * step)
        np.testing.assert_allclose(J_parameters[:, :, i], numeric, atol=1e-5 * max(1.0, np.abs(numeric).max()))
