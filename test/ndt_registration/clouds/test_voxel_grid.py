# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.block_table import find_block
from ndt_registration.clouds.eigen import cholesky_solve6
from ndt_registration.clouds.moments import block_counts, block_moments, coarser
from ndt_registration.clouds.voxel_grid import NormalGrid, adopt_planes, normal_grid
from slam_core.geometry import FloatArray


def test_cholesky_solves_and_refuses_indefinite_matrices(rng: np.random.Generator) -> None:
    A = rng.normal(size=(6, 6))
    A, g, x = A @ A.T + np.eye(6), rng.normal(size=6), np.empty(6)
    assert cholesky_solve6(A, np.full(6, 0.5), g, x)
    np.testing.assert_allclose(x, -np.linalg.solve(A + 0.5 * np.eye(6), g))
    A[2, 2] = -1.0
    assert not cholesky_solve6(A, np.zeros(6), g, x)


def test_cells_have_the_moments_of_the_points_in_them(rng: np.random.Generator) -> None:
    points = rng.uniform(-1.0, 1.0, (3000, 3)) * [1.0, 1.0, 0.2]
    block = 0.25
    moments = coarser(block_moments(points, 0.5 * block))
    grid = normal_grid(moments, block, min_points=6, relative_floor=1e-3, variance_floor=0.0, slack=0.0)
    for point in points[:50]:
        corner = np.floor(point / block).astype(int)
        row = find_block(grid.table, *(int(c) for c in corner))
        for k in range(8):
            low = (corner - [k & 1, (k >> 1) & 1, k >> 2]) * block
            inside = points[((points >= low) & (points < low + 2 * block)).all(axis=1)]
            cell = grid.cells[row, k]
            assert (cell >= 0) == (len(inside) >= 6)
            if cell >= 0:
                assert grid.counts[cell] == len(inside)
                np.testing.assert_allclose(grid.mean[cell], inside.mean(axis=0), atol=1e-12)
                B = np.zeros((3, 3))
                B[np.triu_indices(3)] = grid.information[cell]
                B = B + np.triu(B, 1).T
                np.testing.assert_allclose(B @ np.cov(inside.T), np.eye(3), atol=1e-8)


def test_eigenvalue_floor_bounds_the_information_of_a_plane(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 1.0, (500, 3)) * [1.0, 1.0, 0.0]
    grid = normal_grid(
        block_moments(points, 0.5), 0.5, min_points=6, relative_floor=1e-3, variance_floor=0.0, slack=0.0
    )
    whole = int(np.argmax(grid.counts))
    np.testing.assert_allclose(grid.information[whole][5], 1e3 / grid.variance[whole, 2], rtol=1e-9)


def test_points_slide_along_the_surface_of_cells_with_slack(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 1.0, (500, 3)) * [1.0, 1.0, 0.001]
    grid = normal_grid(
        block_moments(points, 0.5), 0.5, min_points=6, relative_floor=1e-3, variance_floor=0.0, slack=10.0
    )
    whole = int(np.argmax(grid.counts))
    xx, _, _, yy, _, zz = grid.information[whole]
    assert zz > 1000.0
    assert max(xx, yy) < 1e-3 * zz


def test_blocks_too_small_for_the_cloud_are_refused() -> None:
    with pytest.raises(ValueError, match="too small"):
        block_moments(np.array([[1e6, 0.0, 0.0]]), 0.01)


def flat_patch(rng: np.random.Generator, count: int, x: tuple[float, float], z: float) -> FloatArray:
    """Points (n, 3) of a piece of the plane at height ``z`` with 5 mm of noise."""
    return np.column_stack([rng.uniform(*x, count), rng.uniform(0.0, 0.8, count), z + 0.005 * rng.normal(size=count)])


def adopted(points: FloatArray) -> tuple[NormalGrid, NormalGrid]:
    """Cells of 0.1 m as they are and with the normals of those of 0.2 m."""
    fine = block_moments(points, 0.05)
    own, changed, wider = (
        normal_grid(m, size, min_points=6, relative_floor=1e-3, variance_floor=1e-6, slack=10.0)
        for m, size in ((fine, 0.05), (fine, 0.05), (coarser(fine), 0.1))
    )
    adopt_planes(changed, wider, 2.0, 4.0, 1e-6, 10.0)
    return own, changed


def test_cells_of_a_plane_take_the_wider_normal_and_keep_their_mean(rng: np.random.Generator) -> None:
    own, changed = adopted(flat_patch(rng, 20000, (0.0, 0.8), 0.02))
    tilt = [np.sqrt(np.mean(grid.normal[:, 0] ** 2 + grid.normal[:, 1] ** 2)) for grid in (own, changed)]
    assert tilt[1] < 0.4 * tilt[0]
    np.testing.assert_array_equal(changed.mean, own.mean)
    assert changed.counts.mean() > 2.0 * own.counts.mean()


def test_adopted_planes_inform_across_by_what_slack_leaves_of_their_thickness(rng: np.random.Generator) -> None:
    own, changed = adopted(flat_patch(rng, 20000, (0.0, 0.8), 0.02))
    taken = np.abs(changed.normal - own.normal).max(axis=1) > 0
    assert taken.sum() > 40
    thickness = np.maximum(changed.variance[taken, 0], 1e-6)
    expected = 1.0 / thickness - 10.0 / np.maximum(changed.variance[taken, 2], thickness)
    assert (expected > 0).all()
    across = np.einsum("ni,nj->nij", changed.normal[taken], changed.normal[taken])[:, *np.triu_indices(3)]
    np.testing.assert_allclose(changed.information[taken], expected[:, None] * across, rtol=1e-6, atol=1e-6)


def test_cells_at_a_step_keep_their_own_normal(rng: np.random.Generator) -> None:
    """A picture 8 mm before its wall hardly thickens a wide cell, but tilts it by more than the cell beside allows."""
    step = 0.39
    points = np.vstack([flat_patch(rng, 10000, (0.0, step), 0.02), flat_patch(rng, 10000, (step, 0.8), 0.028)])
    own, changed = adopted(points)
    beside = (np.abs(own.mean[:, 0] - step) > 0.05) & (np.abs(own.mean[:, 0] - step) < 0.1)
    assert beside.sum() > 40
    upwards = changed.normal[beside] * np.sign(changed.normal[beside, 2:])
    assert abs(upwards[:, 0].mean()) < 0.015


def test_counts_are_those_of_the_moments(rng: np.random.Generator) -> None:
    far_apart = np.repeat(rng.uniform(-50.0, 50.0, (2000, 3)), 2, axis=0)
    for points in (rng.normal(0.0, 1.0, (500, 3)), 0.8 * np.arange(300.0).reshape(100, 3), far_apart):
        counts = np.sort(block_moments(points, 0.4).counts)
        np.testing.assert_array_equal(np.sort(block_counts(points, 0.4)), counts)


def test_the_table_grows_where_cells_share_no_blocks(rng: np.random.Generator) -> None:
    points = np.repeat(rng.uniform(-50.0, 50.0, (300, 3)), 3, axis=0) + 1e-3 * rng.normal(size=(900, 3))
    grid = normal_grid(block_moments(points, 0.5), 0.5, min_points=3, relative_floor=1e-3, variance_floor=1e-6, slack=0)
    corners = np.floor(points / 0.5).astype(int)[:, None] - np.indices((2, 2, 2)).reshape(3, 8).T
    _, counts = np.unique(corners.reshape(-1, 3), axis=0, return_counts=True)
    assert np.sort(grid.counts).tolist() == np.sort(counts[counts >= 3]).tolist()
    assert all(find_block(grid.table, *np.floor(p / 0.5).astype(int).tolist()) >= 0 for p in points[::30])
