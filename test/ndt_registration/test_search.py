# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ndt_registration.near_field import FULL, lattice_costs, near_field
from ndt_registration.orientation import _bin_directions, best_rotations, direction_density, facing_normals
from ndt_registration.search import PRICES
from ndt_registration.visibility import direction_bin, range_image, visibility_cost
from slam_core.geometry import FloatArray, so3_exp, so3_log


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
    assert without[0] == pytest.approx(visibility_cost(source, shifts[0], image, 0.1, PRICES), abs=1e-9)
