# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ndt_registration.clouds import edges
from ndt_registration.clouds.near_field import FULL, lattice_costs, near_field
from ndt_registration.clouds.orientation import (
    _bin_directions,
    best_rotations,
    direction_density,
    facing_normals,
    rotation_scores,
)
from ndt_registration.clouds.visibility import LEAST_MATCH, direction_bin, range_image, visibility_cost
from ndt_registration.methods.search import PRICES
from slam_core.geometry import FloatArray, make_transform, so3_exp, so3_log


def test_facing_normals_of_a_wall_look_at_the_viewer(rng: np.random.Generator) -> None:
    wall = np.column_stack([np.full(2000, 3.0), rng.uniform(-1.0, 1.0, (2000, 2))])
    wall[:, 0] += 0.005 * rng.normal(size=2000)
    normals = facing_normals(wall, 0.25)
    assert len(normals) > 20
    assert (normals[:, 0] < -0.98).all()


def test_direction_density_is_the_mean_of_bells(rng: np.random.Generator) -> None:
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.exp((normals[:5] @ normals.T - 1.0) / 0.1**2).mean(axis=1)
    np.testing.assert_allclose(direction_density(normals[:5], normals, 0.1), expected, atol=4e-4)


def test_every_bin_of_the_direction_image_holds_its_own_direction() -> None:
    directions = _bin_directions()
    size = round(np.sqrt(len(directions)))
    assert [direction_bin(*direction, size) for direction in directions] == list(range(size * size))


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.5), (0.2, -0.3, 0.1)])
def test_the_best_rotation_turns_the_normals_into_each_other(
    rng: np.random.Generator, vector: tuple[float, float, float]
) -> None:
    axes = np.repeat(np.eye(3), [80, 15, 8], axis=0)
    target = axes + 0.03 * rng.normal(size=axes.shape)
    target /= np.linalg.norm(target, axis=1, keepdims=True)
    R = so3_exp(np.array(vector))
    found = best_rotations(target[::2] @ R, target[1::2], np.deg2rad(40.0), np.deg2rad(7.0), 4)
    assert np.linalg.norm(so3_log(found[0] @ R.T)) < np.deg2rad(3.0)


def test_without_normals_the_sensor_is_taken_not_to_turn() -> None:
    np.testing.assert_array_equal(best_rotations(np.empty((0, 3)), np.eye(3), 0.6, 0.1, 4), np.eye(3)[None])


def test_nearness_falls_with_every_voxel() -> None:
    field = near_field(np.array([[0.05, 0.05, 0.05], [50.0, 0.0, 0.0]]), 0.1, 1.0)
    centre = tuple(np.argwhere(field.values == FULL)[0])
    assert np.count_nonzero(field.values == FULL) == 1
    assert field.values[centre[0] + 1, centre[1], centre[2]] == FULL - 1
    assert field.values[centre[0] - 1, centre[1] + 1, centre[2] - 1] == FULL - 3
    assert field.values[centre[0] + 2, centre[1], centre[2]] == 0


def test_the_lattice_prefers_the_true_pose(room: Any, start: FloatArray, at: Callable[..., FloatArray]) -> None:
    rng = np.random.default_rng(5)
    target, source = room.scan(start, rng), room.scan(start @ at(0.0, 0.5), rng)[::20].copy()
    image, field = range_image(target, 64), near_field(target, 0.15, 7.0)
    shifts = np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, -0.5, 0.0]])
    costs = lattice_costs(source, np.eye(3)[None], shifts, image, 0.1, PRICES, field, 0.3)
    assert costs.shape == (1, 4)
    assert costs.argmin() == 0
    without = lattice_costs(source, np.eye(3)[None], shifts, image, 0.1, PRICES, field, 0.0)[0]
    assert without[0] == pytest.approx(
        visibility_cost(source, make_transform(np.eye(3), shifts[0]), image, 0.1, PRICES), abs=1e-9
    )


def test_visibility_cost_is_the_mean_over_points(rng: np.random.Generator) -> None:
    seen = rng.normal([0.0, 0.0, 2.0], size=(4000, 3))
    image = range_image(3.0 * seen / np.linalg.norm(seen, axis=1, keepdims=True), 16)
    points, T = rng.normal([0.0, 0.2, 3.0], 0.8, size=(203, 3)), make_transform(np.eye(3), np.array([0.1, 0.0, 0.3]))
    cost, matches = 0.0, 0
    for x, y, z in points + T[:3, 3]:
        k, r = direction_bin(x, y, z, np.int32(16)), np.sqrt(x * x + y * y + z * z)
        near, far = image.near[k], image.far[k]
        if far == 0.0:
            cost += PRICES.unseen
        elif r > far + 0.1:
            cost += PRICES.hidden * min((r - far) / 0.1 - 1.0, 1.0)
        elif r < near - 0.1:
            cost += PRICES.free * min((near - r) / 0.1 - 1.0, 1.0)
        else:
            matches += 1
    assert 10 < matches < 0.5 * len(points)
    expected = cost / len(points) + max(1.0 - matches / len(points) / LEAST_MATCH, 0.0)
    assert visibility_cost(points, T, image, 0.1, PRICES) == pytest.approx(expected, abs=1e-12)


def test_rotation_scores_look_up_the_turned_normals(rng: np.random.Generator) -> None:
    normals, weights, image = rng.normal(size=(37, 3)), rng.random(37), rng.random(16 * 16)
    R = so3_exp(rng.normal(size=(5, 3)))
    expected = [sum(w * image[direction_bin(*n, 16)] for w, n in zip(weights, normals @ r.T, strict=True)) for r in R]
    np.testing.assert_allclose(rotation_scores(R, normals, weights, image, 16), expected, atol=1e-12)


def test_no_rim_is_lost_where_nothing_farther_is_near(room: Any, start: FloatArray) -> None:
    points = room.scan(start, np.random.default_rng(3))[::7].copy()
    size, reach, step = 40, 0.03, 0.1
    sorted_points = edges._sorted_by_bin(points, size)
    found, around = [np.zeros_like(points) for _ in range(2)], np.empty((5, len(points)))
    for out, farthest in zip(found, (sorted_points[4], np.full(size * size, np.inf)), strict=True):
        assert edges._find_rims(size, reach, step, *sorted_points[:4], farthest, around, out) > 20
    np.testing.assert_array_equal(*found)
