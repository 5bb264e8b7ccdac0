# SPDX-License-Identifier: Apache-2.0
"""The storey that a rig is on: while it walks, climbs stairs to and fro, and rides a lift past a floor."""

from __future__ import annotations

import itertools

import numpy as np

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.plans.levelling import floor_heights
from dense_mapping.plans.storeys import CurrentStorey, storey_number
from slam_core.geometry import make_transform

PLANS = tuple(
    FloorPlan(np.zeros((4, 4), np.int8), 0.5, make_transform(np.eye(3), np.array([0.0, 0.0, height])))
    for height in (0.0, 3.0, 6.0)
)


def at(height: float) -> np.ndarray:
    return np.array([1.0, 1.0, height])


def test_a_place_belongs_to_the_highest_floor_below_it() -> None:
    found = [storey_number(PLANS, at(z)) for z in (-2.0, 0.1, 2.6, 2.8, 4.3, 9.0)]
    assert found == [0, 0, 0, 1, 1, 2]
    assert storey_number([], at(1.0)) is None


def test_the_storey_changes_once_it_is_clearly_another() -> None:
    current = CurrentStorey()
    assert not current.update((), at(1.2))
    assert current.number is None
    heights = [1.2, 2.6, 2.8, 3.3, 2.9, 2.6, 3.4, 3.6, 4.2, 2.8, 2.6, 2.4, 1.2, 4.2, 7.2]
    seen = [(current.update(PLANS, at(z)), current.number) for z in heights]
    numbers = [number for _, number in seen]
    assert numbers == [0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 2]
    changes = [changed for changed, _ in seen]
    assert changes == [True, *[a != b for a, b in itertools.pairwise(numbers)]]


def test_a_plan_that_vanished_is_left() -> None:
    current = CurrentStorey()
    current.update(PLANS, at(7.0))
    assert current.number == 2
    assert current.update(PLANS[:2], at(7.0))
    assert current.number == 1


def test_treads_of_stairs_are_no_floor() -> None:
    """Floors at 0 and 3 m, of which the upper one is seen less than the treads between them."""
    rng = np.random.default_rng(1)
    levels = np.concatenate([np.full(900, 0.0), *(np.full(600, 0.18 * k) for k in range(1, 13)), np.full(500, 3.0)])
    points = np.column_stack(
        [rng.uniform(0.0, 5.0, (len(levels), 2)), levels + 0.01 * rng.standard_normal(len(levels))]
    )
    heights = np.concatenate([np.full(60, 1.3), np.linspace(1.3, 4.3, 20), np.full(60, 4.3)])
    cameras = np.column_stack([np.zeros((len(heights), 2)), heights])
    floors = floor_heights(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), cameras, 2.0, 1.3)
    np.testing.assert_allclose(floors, [0.0, 3.0], atol=0.05)
