# SPDX-License-Identifier: Apache-2.0
"""Fit of a cloud to cells: curvature made by errors of normals, gradients of blocks."""

from __future__ import annotations

import numpy as np

from ndt_registration.clouds.moments import block_moments
from ndt_registration.clouds.voxel_grid import normal_grid, note_spurious_information
from ndt_registration.methods.matching import block_gradients, fit_to_grid
from ndt_registration.methods.ndt import Layer, ndt_align
from slam_core.geometry import FloatArray


def noisy_plane(rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) of a plane with 1 mm of noise."""
    return np.column_stack([rng.uniform(0.0, 0.9, (6000, 2)), 0.02 + 0.001 * rng.normal(size=6000)])


def noisy_layer(rng: np.random.Generator) -> Layer:
    """Two looks at one plane: cells of 0.1 m with their own normals, and points."""
    grid = normal_grid(
        block_moments(noisy_plane(rng), 0.05),
        0.05,
        min_points=6,
        relative_floor=1e-6,
        variance_floor=2.5e-7,
        slack=10.0,
    )
    note_spurious_information(grid)
    return Layer(noisy_plane(rng), grid, 1.0)


def test_a_plane_holds_points_along_itself_by_the_errors_of_its_normals(rng: np.random.Generator) -> None:
    """All of the curvature along a plane is spurious.

    What is taken off is a little more: both directions along count as the narrower of a cell's two spreads.
    """
    spurious, curvature = np.zeros((2, 6, 6)), np.zeros((2, 6, 6))
    for _ in range(8):
        layer = noisy_layer(rng)
        there = ndt_align((layer,), np.eye(3), np.zeros(3), np.zeros(6), 1.0, 0, 0.0)
        fit = fit_to_grid(layer.points, np.eye(3), np.zeros(3), layer.grid, layer.grid, 0.3)
        spurious += np.stack([fit.spurious_hessian, fit.spurious_majorant])
        curvature += np.stack([there.hessian, there.majorant])
    along = [0, 1, 5]  # both translations, and the turn about the normal
    ratio = np.diagonal(curvature, axis1=1, axis2=2)[:, along] / np.diagonal(spurious, axis1=1, axis2=2)[:, along]
    assert np.all((ratio > 0.6) & (ratio < 1.0))


def test_pulls_of_the_blocks_add_up_to_the_gradient(rng: np.random.Generator) -> None:
    layer, t = noisy_layer(rng), np.array([0.01, 0.0, 0.003])
    there = ndt_align((layer,), np.eye(3), t, np.zeros(6), 1.0, 0, 0.0)
    gradients, places = block_gradients(layer, np.eye(3), t)
    np.testing.assert_allclose(
        gradients.sum(axis=0), there.gradient, rtol=1e-6, atol=1e-6 * np.abs(there.gradient).max()
    )
    assert len(gradients) == len(np.unique(places, axis=0)) > 250
