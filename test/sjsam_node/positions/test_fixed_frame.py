# SPDX-License-Identifier: Apache-2.0
"""The frame of positions: found with outliers, and only where it is determined."""

from __future__ import annotations

import numpy as np

from sjsam_node.positions.fixed_frame import LARGEST_ANGLE, find_frame
from slam_core.geometry import FloatArray, boxminus, boxplus, invert_transform, transform_points

SIGMA = 0.1
T = boxplus(np.eye(4), np.array([80.0, -30.0, 5.0, 0.1, -0.2, 2.5]))
"""T_map_frame."""
LINE = np.linspace([0.0, 0.0, 1.0], [20.0, 0.0, 1.0], 40)
CORNER = np.concatenate([LINE, np.linspace([20.0, 0.5, 1.0], [20.0, 10.0, 1.0], 20)])


def measured(places: FloatArray, seed: int = 0) -> FloatArray:
    noise = SIGMA * np.random.default_rng(seed).normal(size=places.shape)
    return np.asarray(transform_points(invert_transform(T), places) + noise)


def variances(n: int, drift: float = 0.0) -> tuple[FloatArray, FloatArray]:
    return np.full(n, SIGMA**2), np.full(n, drift**2)


def test_around_a_corner_it_is_found_whatever_a_third_of_the_positions_say() -> None:
    positions = measured(CORNER)
    positions[::3] += [0.0, 3.0, 4.0]
    found = find_frame(CORNER, positions, *variances(len(CORNER)))
    assert found is not None
    assert not found.agrees[::3].any()
    assert found.agrees.sum() == len(CORNER) - 20
    middle = boxminus(found.T @ positions_at(CORNER), T @ positions_at(CORNER))
    assert np.linalg.norm(middle[:3]) < 0.1
    assert np.linalg.norm(middle[3:]) < 0.03


def positions_at(places: FloatArray) -> FloatArray:
    """The middle of some places, as a pose in the fixed frame."""
    out = np.eye(4)
    out[:3, 3] = transform_points(invert_transform(T), places).mean(axis=0)
    return out


def test_along_a_line_it_is_not_determined_even_where_the_map_is_bent() -> None:
    bent = LINE + np.sin(np.linspace(0.0, np.pi, len(LINE)))[:, None] * [0.0, 0.4, 0.7]
    assert all(find_frame(LINE, measured(LINE, seed), *variances(len(LINE))) is None for seed in range(5))
    assert all(find_frame(bent, measured(LINE, seed), *variances(len(LINE), 0.4)) is None for seed in range(5))
    assert LARGEST_ANGLE < 0.3


def test_positions_that_do_not_agree_give_none() -> None:
    anywhere = np.random.default_rng(3).uniform(-10.0, 10.0, CORNER.shape)
    assert find_frame(CORNER, anywhere, *variances(len(CORNER))) is None
    assert find_frame(CORNER[:7], measured(CORNER)[:7], *variances(7)) is None
