# SPDX-License-Identifier: Apache-2.0
"""Groups of points with the cells around them, beside plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.block_table import find_block
from ndt_registration.clouds.moments import block_moments
from ndt_registration.clouds.voxel_grid import NormalGrid, normal_grid
from ndt_registration.methods.lanes import LANES, gather, groups_of, mean_over_cells, no_neighbours
from ndt_registration.methods.ndt import Layer
from ndt_registration.methods.score_loss import ScoreLoss, point_fits
from slam_core.geometry import FloatArray, boxplus

POINTS = 3 * LANES + 5


@pytest.fixture
def points(rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) of two walls that do not fill their last group."""
    walls = rng.uniform(-1.0, 1.0, (4000, 3))
    walls[np.arange(4000), rng.integers(0, 2, 4000)] = 0.003 * rng.normal(size=4000)
    return walls


@pytest.fixture
def grid(points: FloatArray) -> NormalGrid:
    moments = block_moments(points, 0.1)
    return normal_grid(moments, 0.1, min_points=6, relative_floor=1e-3, variance_floor=1e-4, slack=0.0)


def numpy_fits(points: FloatArray, grid: NormalGrid) -> FloatArray:
    """Mean of Eq. 8.5 over the cells of each point, -1 where there is none."""
    fits = np.full(len(points), -1.0)
    for i, x in enumerate(points):
        row = find_block(grid.table, *(int(c) for c in np.floor(x / grid.block_size)))
        cells = grid.cells[row][grid.cells[row] >= 0] if row >= 0 else np.empty(0, int)
        if len(cells):
            B = np.zeros((len(cells), 3, 3))
            B[:, *np.triu_indices(3)] = grid.information[cells]
            B += np.swapaxes(np.triu(B, 1), 1, 2)
            q = x - grid.mean[cells]
            fits[i] = np.exp(-0.5 * np.einsum("ki,kij,kj->k", q, B, q)).mean()
    return fits


def test_points_keep_the_mean_fit_to_their_cells(points: FloatArray, grid: NormalGrid) -> None:
    some = np.ascontiguousarray(points[:POINTS])
    some[::7] += 5.0
    at, fits = no_neighbours(1), np.empty(0)
    for group in range(groups_of(POINTS)):
        count = gather(some, group, grid, np.eye(3), np.zeros(3), at, -group)
        mean_over_cells(at.cells[0], at.place, at.sums)
        fits = np.append(fits, at.sums[:count])
    expected = numpy_fits(some, grid)
    assert (expected < 0.0).sum() > 5
    np.testing.assert_allclose(fits, expected, atol=1e-5)


def test_a_loss_among_few_points_that_is_large_ends_the_search(points: FloatArray, grid: NormalGrid) -> None:
    layers = Layer(np.ascontiguousarray(points[:2000]), grid, 1.0), Layer(np.ascontiguousarray(points[:60]), grid, 0.5)
    step = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    of_all, of_few = ScoreLoss(layers, np.eye(4)).loss(step), ScoreLoss(layers, np.eye(4), clear=0.1).loss(step)
    assert of_all > 0.2
    assert of_few == pytest.approx(of_all, rel=0.3)
    assert ScoreLoss(layers, np.eye(4), clear=0.9).loss(step) == of_all


def test_the_loss_is_the_lesser_of_a_step_forth_and_back(points: FloatArray, grid: NormalGrid) -> None:
    rims = np.ascontiguousarray(points[:60])
    layers, step = (Layer(points, grid, 1.0), Layer(rims, grid, 0.5)), np.array([0.05, 0.02, 0.0, 0.0, 0.0, 0.03])
    losses = []
    for d in (step, -step):
        T = boxplus(np.eye(4), d)
        before, after = (
            [point_fits(layer, np.ascontiguousarray(P[:3, :3]), P[:3, 3].copy()) for layer in layers]
            for P in (np.eye(4), T)
        )
        both = (before[0] >= 0.0) & (after[0] >= 0.0)
        was, then = (fits[0][both].sum() + 0.5 * np.maximum(fits[1], 0.0).sum() for fits in (before, after))
        losses.append(1.0 - then / was)
    assert ScoreLoss(layers, np.eye(4)).loss(step) == pytest.approx(min(losses), abs=1e-6)
