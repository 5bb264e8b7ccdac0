# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.block_table import find_block
from ndt_registration.clouds.moments import block_moments
from ndt_registration.clouds.voxel_grid import normal_grid
from ndt_registration.methods.lanes import Neighbours, groups_of, no_neighbours
from ndt_registration.methods.ndt import Layer, cost_and_derivatives, ndt_align
from slam_core.geometry import FloatArray, boxminus, boxplus, make_transform, transform_points

STATES = [np.zeros(6), np.array([0.03, -0.02, 0.01, 0.02, -0.05, 0.03]), np.array([-0.1, 0.05, 0.02, -0.3, 0.2, 0.6])]


@pytest.fixture(scope="module")
def layer() -> Layer:
    rng = np.random.default_rng(3)
    corner = rng.uniform(0.0, 1.0, (6000, 3))
    corner[np.arange(6000), rng.integers(0, 3, 6000)] = 0.002 * rng.normal(size=6000)
    grid = normal_grid(
        block_moments(corner, 0.2), 0.2, min_points=6, relative_floor=1e-3, variance_floor=1e-3, slack=0.0
    )
    return Layer(np.ascontiguousarray(corner[:400] + 0.01), grid, 0.7)


def numpy_cost(layer: Layer, T: FloatArray, T_cells: FloatArray | None = None) -> float:
    """The sum of Eq. 8.5 over the cells that points have at ``T_cells``, by default at ``T``, without kernels."""
    grid, total = layer.grid, 0.0
    placed = transform_points(T if T_cells is None else T_cells, layer.points)
    for x, place in zip(transform_points(T, layer.points), placed, strict=True):
        row = find_block(grid.table, *(int(c) for c in np.floor(place / grid.block_size)))
        cells = grid.cells[row][grid.cells[row] >= 0] if row >= 0 else np.empty(0, int)
        B = np.zeros((len(cells), 3, 3))
        B[:, *np.triu_indices(3)] = grid.information[cells]
        B += np.swapaxes(np.triu(B, 1), 1, 2)
        q = x - grid.mean[cells]
        total -= layer.factor * np.exp(-0.5 * np.einsum("ki,kij,kj->k", q, B, q)).sum() / 8.0
    return total


def evaluate(
    layer: Layer, T: FloatArray, neighbours: Neighbours | None = None
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    g, H, M = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    neighbours = neighbours or no_neighbours(groups_of(len(layer.points)))
    cost = cost_and_derivatives((layer,), np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), neighbours, g, H, M)
    return cost, g, H, M


@pytest.mark.parametrize("state", STATES)
def test_cost_agrees_with_numpy(layer: Layer, state: FloatArray) -> None:
    T = boxplus(np.eye(4), state)
    assert evaluate(layer, T)[0] == pytest.approx(numpy_cost(layer, T), rel=1e-6)


def test_neighbours_of_the_step_before_change_nothing(layer: Layer) -> None:
    kept = no_neighbours(groups_of(len(layer.points)))
    for state in STATES * 2:
        T = boxplus(np.eye(4), state)
        for again, anew in zip(evaluate(layer, T, kept), evaluate(layer, T), strict=True):
            np.testing.assert_array_equal(again, anew)


@pytest.mark.parametrize("state", STATES)
def test_gradient_and_hessian_agree_with_central_differences(layer: Layer, state: FloatArray) -> None:
    T = boxplus(np.eye(4), state)
    few = Layer(layer.points[:40], layer.grid, layer.factor)
    _, g, H, _ = evaluate(few, T)
    cost = lambda d: numpy_cost(few, boxplus(T, d), T)  # noqa: E731
    e, h = 1e-5, 1e-4
    numeric = np.array([(cost(e * u) - cost(-e * u)) / (2 * e) for u in np.eye(6)])
    np.testing.assert_allclose(g, numeric, atol=1e-5 * np.abs(g).max())
    second = np.array([
        [(cost(h * (u + v)) - cost(h * (u - v)) - cost(h * (v - u)) + cost(-h * (u + v))) / (4 * h * h) for v in
        np.eye(6)] for u in np.eye(6)
    ])  # fmt: skip
    np.testing.assert_allclose(H, second, atol=1e-4 * np.abs(second).max())


def test_majorant_is_positive_semidefinite_where_the_hessian_is_not(layer: Layer) -> None:
    _, _, H, M = evaluate(layer, boxplus(np.eye(4), STATES[2]))
    assert np.linalg.eigvalsh(M).min() > -1e-9 * np.abs(M).max()
    assert np.linalg.eigvalsh(H).min() < 0.0


def test_descent_finds_the_pose_and_holds_what_is_fixed(layer: Layer) -> None:
    exact = Layer(np.ascontiguousarray(layer.points - 0.01), layer.grid, 1.0)
    T = boxplus(np.eye(4), np.array([0.03, -0.03, 0.02, 0.01, -0.02, 0.02]))
    optimum = ndt_align((exact,), np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), np.zeros(6), 1.0, 50, 1e-6)
    error = boxminus(make_transform(optimum.rotation, optimum.translation), np.eye(4))
    assert optimum.converged
    assert np.abs(error).max() < 0.02
    held = ndt_align((exact,), np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), np.ones(6), 1.0, 50, 1e-6)
    np.testing.assert_allclose(held.translation, T[:3, 3], atol=1e-6)
