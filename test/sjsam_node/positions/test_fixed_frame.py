# SPDX-License-Identifier: Apache-2.0
"""The frame of positions: found with outliers, and only where it is determined."""

from __future__ import annotations

import numpy as np

from sjsam_node.positions.fixed_frame import LARGEST_ANGLE, _step, find_frame
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
    return np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)), np.full(n, drift**2)


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


def test_where_the_height_says_little_an_outlier_beside_the_way_is_refused_all_the_same() -> None:
    noise = np.tile(np.diag([SIGMA, SIGMA, 2.0]) ** 2, (len(CORNER), 1, 1))
    level = boxplus(np.eye(4), np.array([80.0, -30.0, 5.0, 0.0, 0.0, 2.5]))
    places = CORNER + np.sin(np.arange(len(CORNER)))[:, None] * [0.0, 0.0, 0.2]
    errors = np.random.default_rng(2).normal(size=CORNER.shape) * [SIGMA, SIGMA, 2.0]
    errors[5::10] = np.array([[2.0, 0.0, 0.0], [0.0, -2.0, 0.0]] * 3)
    found = find_frame(places, transform_points(invert_transform(level), places) + errors, noise, np.zeros(len(noise)))
    assert found is not None, "undetermined"
    assert np.nonzero(~found.agrees)[0].tolist() == list(range(5, len(CORNER), 10))


def test_one_step_leads_from_a_turned_frame_to_the_optimum() -> None:
    turned = T @ boxplus(np.eye(4), np.array([0.0, 0.0, 0.0, 0.001, -0.002, 0.003]))
    positions, everything = transform_points(invert_transform(T), CORNER), np.ones(len(CORNER), np.bool_)
    found = _step(turned, CORNER, positions, np.tile(np.eye(3), (len(CORNER), 1, 1)), everything)
    assert np.linalg.norm(CORNER - transform_points(found, positions), axis=1).max() < 0.005


def test_the_covariance_of_a_frame_is_what_it_errs_by() -> None:
    nees = []
    for seed in range(40):
        found = find_frame(CORNER, measured(CORNER, seed), *variances(len(CORNER)))
        assert found is not None, seed
        d = boxminus(T, found.T)
        nees.append(d @ np.linalg.solve(found.covariance, d) / 6.0)
    assert 0.75 < np.mean(nees) < 1.25
