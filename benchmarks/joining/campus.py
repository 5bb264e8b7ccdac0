# SPDX-License-Identifier: Apache-2.0
"""A campus of corridors and the local maps of many agents that walk through it, with known landmarks: no images."""

from __future__ import annotations

import numpy as np

from sjsam_node.joint_problem.problem import FlatMaps, JoiningState
from slam_core.geometry import FloatArray, so3_exp
from slam_core.linear_algebra.block_pattern import IntArray, pointers

BLOCK_M = 20
"""Distance of parallel corridors, m."""
DENSITY = 8
"""Landmarks per metre of corridor."""
SEEN = 20
"""Landmarks of a submap, the nearest ones to its middle."""
VISITS = 4.0
"""Times that each metre of the campus is walked, on average."""
_AT_ONCE = 2000
"""Submaps whose covariances are in memory at a time, 35 kB each."""


def campus(agents: int, submaps: int, seed: int = 0) -> tuple[FlatMaps, JoiningState, IntArray]:
    """Local maps of a metre each, a state near the truth, and the fixed pose.

    Each agent begins somewhere and turns at random where corridors meet. Poses are numbered by agent and time,
    ``submaps + 1`` each.
    """
    rng = np.random.default_rng(seed)
    # Corridors along x and y, BLOCK_M apart: 2 (n + 1) n BLOCK_M metres in all.
    n = max(2, round(np.sqrt(agents * submaps / VISITS / (2 * BLOCK_M))))
    places, headings = zip(*(walk(n, submaps, rng) for _ in range(agents)), strict=True)
    xy, yaw = np.array(places, dtype=np.float64), np.array(headings)
    landmarks = landmarks_on_walls(n, rng)
    poses = agents * (submaps + 1)
    t = np.concatenate([xy.reshape(poses, 2) + rng.uniform(-0.3, 0.3, (poses, 2)), np.zeros((poses, 1))], axis=1)
    R = so3_exp(np.stack([*rng.normal(0, 0.02, (2, poses)), yaw.ravel()], axis=1))
    reference = (np.arange(agents)[:, None] * (submaps + 1) + np.arange(submaps)).ravel()
    seen = _seen(landmarks, 0.5 * (t[reference] + t[reference + 1]))
    names, ids = np.unique(seen, return_inverse=True)
    maps = _measured(R, t, landmarks[names], reference, ids.reshape(seen.shape), rng)
    drift = so3_exp(rng.normal(0, 0.002, (poses, 3)))
    state = JoiningState(
        np.ascontiguousarray(drift @ R), t + rng.normal(0, 0.01, t.shape),
        landmarks[names] + rng.normal(0, 0.01, (len(names), 3)),
    )  # fmt: skip
    return maps, state, np.array([0])


def walk(n: int, steps: int, rng: np.random.Generator) -> tuple[list[tuple[int, int]], list[float]]:
    """Places (steps + 1) in metres, on the grid of corridors, and headings there."""
    at = np.array([rng.integers(0, n + 1) * BLOCK_M, rng.integers(0, n * BLOCK_M + 1)])
    direction, places, headings = np.array([0, 1]), [], []
    for _ in range(steps + 1):
        if not (at % BLOCK_M).any() or not _is_inside(at + direction, n):
            ways = [np.array(d) for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]
            on_crossing = not (at % BLOCK_M).any()
            open_ways = [d for d in ways if _is_inside(at + d, n) and (on_crossing or d @ direction != 0)]
            ahead = [d for d in open_ways if (d != -direction).any()] or open_ways
            direction = ahead[rng.integers(len(ahead))]
        places.append((int(at[0]), int(at[1])))
        headings.append(float(np.arctan2(direction[1], direction[0])))
        at = at + direction
    return places, headings


def _is_inside(at: IntArray, n: int) -> bool:
    return bool(((at >= 0) & (at <= n * BLOCK_M)).all())


def landmarks_on_walls(n: int, rng: np.random.Generator) -> FloatArray:
    """Landmarks on the walls of all corridors, (l, 3) m."""
    along = rng.uniform(0, n * BLOCK_M, (2 * (n + 1), n * BLOCK_M * DENSITY))
    across = np.repeat(np.arange(n + 1) * BLOCK_M, 2)[:, None] + rng.choice([-1.2, 1.2], along.shape)
    x = np.where(np.arange(len(along))[:, None] % 2 == 0, along, across)
    y = np.where(np.arange(len(along))[:, None] % 2 == 0, across, along)
    return np.stack([x.ravel(), y.ravel(), rng.uniform(0, 2.5, x.size)], axis=1)


def _seen(landmarks: FloatArray, middles: FloatArray) -> IntArray:
    """The nearest landmarks (submaps, SEEN) of each submap, ascending."""
    from scipy.spatial import cKDTree

    return np.sort(cKDTree(landmarks[:, :2]).query(middles[:, :2], SEEN)[1], axis=1).astype(np.int64)


def _measured(
    R: FloatArray, t: FloatArray, landmarks: FloatArray, reference: IntArray, ids: IntArray, rng: np.random.Generator
) -> FlatMaps:
    """Local maps with a common error of all that each of them sees, and one of every landmark."""
    from slam_core.geometry import so3_log

    count, rows = len(reference), 6 + 3 * SEEN
    base, T = np.swapaxes(R[reference], 1, 2), t[reference]
    end = np.concatenate([(base @ (t[reference + 1] - T)[..., None])[..., 0], so3_log(base @ R[reference + 1])], axis=1)
    local = np.einsum("nij,nkj->nki", base, landmarks[ids] - T[:, None])
    sigma = np.concatenate([np.repeat([0.01, 0.002], 3), np.full(3 * SEEN, 0.02)])
    mean, information = np.concatenate([end, local.reshape(count, -1)], axis=1), np.empty((count, rows, rows))
    for first in range(0, count, _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        common = rng.normal(0, 0.2, (len(mean[part]), rows, 6)) * sigma[:, None]
        mean[part] += (common @ rng.normal(size=(len(common), 6, 1)))[..., 0]
        mean[part] += sigma * rng.normal(size=(len(common), rows))
        information[part] = np.linalg.inv(common @ np.swapaxes(common, 1, 2) + np.diag(sigma**2))
    ones, seen = np.ones(count, dtype=np.int64), np.full(count, SEEN)
    return FlatMaps(
        reference, pointers(ones), reference + 1, pointers(seen), ids.ravel(), pointers(np.full(count, rows)),
        mean.ravel(), pointers(np.full(count, rows * rows)), information.ravel(), np.zeros(count * rows),
    )  # fmt: skip
