# SPDX-License-Identifier: Apache-2.0
"""ICP in the plane: normals lie in it, also where rounding has lifted points off it, and a corner is registered."""

from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.methods.icp import IcpConfig, IcpTarget, icp_align
from slam_core.geometry import (
    FloatArray,
    boxminus,
    invert_transform,
    make_transform,
    rotation_from_euler,
    transform_points,
)


def corner(rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) of two walls at a right angle and a slanted one, z = 0."""
    line = np.linspace(0.0, 3.0, 150)
    walls = [
        np.column_stack([line, 0 * line]),
        np.column_stack([0 * line, line]),
        np.column_stack([line, 3.0 + 0.5 * line]),
    ]
    xy = np.concatenate(walls) + 0.003 * rng.normal(size=(450, 2))
    return np.column_stack([xy, np.zeros(450)])


@pytest.mark.parametrize("lift", [0.0, 1e-15])
def test_normals_of_a_planar_cloud_lie_in_the_plane(lift: float) -> None:
    rng = np.random.default_rng(1)
    points = corner(rng) + lift * rng.normal(size=(450, 3)) * [0.0, 0.0, 1.0]
    normals = IcpTarget(points).normals
    np.testing.assert_array_equal(normals[:, 2], 0.0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.median(np.abs(normals[20:130, 1])) > 0.99  # of the wall along x


SPACING = 0.02
"""Distance of neighbouring points of a wall, m: what pairs of points cannot see below."""


@pytest.mark.parametrize(("plane", "limit"), [(True, 0.25 * SPACING), (False, SPACING)])
def test_planar_scans_are_registered(plane: bool, limit: float) -> None:
    rng, config = np.random.default_rng(2), IcpConfig()
    truth = make_transform(rotation_from_euler(0.08), np.array([0.12, -0.07, 0.0]))
    source = transform_points(invert_transform(truth), corner(rng))
    outcome = icp_align(
        source, IcpTarget(corner(rng)), np.eye(4), 2.0, config, coarse_points=10_000, plane=plane, planar=True
    )
    error = boxminus(outcome.T, truth)
    assert outcome.converged
    assert np.linalg.norm(error[:2]) < limit
    assert abs(error[5]) < limit / 2.0
    np.testing.assert_allclose(error[2:5], 0.0, atol=1e-12)


@pytest.mark.parametrize("plane", [True, False])
def test_points_beyond_the_rejection_limit_pull_at_nothing(plane: bool) -> None:
    """A quarter of the source lies on a thing that the target has not: with a limit it is left out."""
    rng = np.random.default_rng(4)
    target = corner(rng)
    stray = np.column_stack([rng.uniform((1.0, 1.4), (2.0, 2.4), (150, 2)), np.zeros(150)])
    source = np.concatenate([corner(rng), stray])
    errors = []
    for limit in (0.1, 5.0):
        config = IcpConfig(max_distance=limit, final_spacings=limit / SPACING, trimmed=1.0)
        outcome = icp_align(
            source, IcpTarget(target), np.eye(4), 2.0, config, coarse_points=10_000, plane=plane, planar=True
        )
        errors.append(float(np.linalg.norm(outcome.T[:2, 3])))
    assert errors[0] < 0.01
    assert errors[1] > 3.0 * errors[0]
