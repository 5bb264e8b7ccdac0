# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ndt_registration.clouds.edges import REACH_SPACINGS, rim_points
from slam_core.geometry import FloatArray


def rims_of_twin(points: FloatArray, reach: float, step: float) -> FloatArray:
    """The rims by all pairs of points."""
    ranges = np.linalg.norm(points, axis=1)
    directions = points / ranges[:, None]
    rims = []
    for d, r in zip(directions, ranges, strict=True):
        beside = directions - d
        gaps = np.where(ranges > r + step, (beside**2).sum(axis=1), np.inf)
        nearest = int(np.argmin(gaps))
        if not gaps[nearest] < reach**2:
            continue
        behind, gap = beside[nearest], gaps[nearest]
        along = beside @ behind / gap
        across = (beside**2).sum(axis=1) - along**2 * gap
        goes_on = (ranges <= r + step) & (along > 0.3) & (along < 2.0) & (across < gap)
        if not goes_on.any():
            rims.append(0.5 * r * (d + directions[nearest]))
    return np.array(rims).reshape(-1, 3)


@pytest.mark.parametrize("spacing", [0.004, 0.02, 0.8])
def test_rims_are_those_of_all_pairs(rng: np.random.Generator, spacing: float) -> None:
    """A box before a wall; with the widest spacing every point is within reach of every other."""
    wall = np.column_stack([rng.uniform(-1.5, 1.5, (900, 2)), np.full(900, 3.0)])
    box = np.column_stack([rng.uniform(-0.4, 0.4, (300, 2)), np.full(300, 1.5)])
    hidden = np.abs(wall[:, :2] / wall[:, 2:]).max(axis=1) < 0.4 / 1.5
    points = rng.permutation(np.concatenate([wall[~hidden], box]))
    found, expected = rim_points(points, spacing, 0.1), rims_of_twin(points, REACH_SPACINGS * spacing, 0.1)
    assert len(found) == len(expected) >= (5 if spacing < 0.5 else 1)
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], atol=1e-12)
