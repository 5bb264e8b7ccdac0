# SPDX-License-Identifier: Apache-2.0
"""Submaps whose landmarks err together, as the rig's drift makes them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam_core.geometry import boxplus
from slam_core.types import PoseEstimate, Submap

sys.path.insert(0, str(Path(__file__).parent))  # radio_world


def made(n: int, seed: int = 1, common: int = 5, dimension: int = 128, agent: str = "one", index: int = 3) -> Submap:
    """A submap of n landmarks with ``common`` shared directions of error."""
    rng = np.random.default_rng(seed)
    m, start = 6 + 3 * n, 2 * 10**9 * index
    scale = np.concatenate([[0.01] * 3, [0.003] * 3, np.full(3 * n, 0.02)])
    shared = rng.normal(size=(m, common)) * scale[:, None]
    own = np.zeros((m, m))
    for rows in [slice(0, 6), *(slice(k, k + 3) for k in range(6, m, 3))]:
        A = rng.normal(size=(rows.stop - rows.start, 8)) * 0.3
        own[rows, rows] = (A @ A.T) * np.outer(scale[rows], scale[rows])
    covariance = shared @ shared.T + own
    end = boxplus(np.eye(4), np.array([1.0, 0.2, -0.1, 0.05, -0.02, 0.3]))
    halfway = boxplus(np.eye(4), np.array([0.5, 0.1, -0.05, 0.02, -0.01, 0.15]))
    path = tuple(
        PoseEstimate(start + 10**9 * k, T, (1e-9 + 0.25 * k**2) * covariance[:6, :6] / (1.0 + 1e-9))
        for k, T in enumerate((np.eye(4), halfway, end))
    )
    descriptors = rng.normal(size=(n, dimension)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Submap(
        agent=agent, index=index, start_stamp_ns=start, end_stamp_ns=start + 2 * 10**9, end_pose=end,
        landmarks=rng.uniform(-4.0, 4.0, size=(n, 3)), covariance=covariance,
        landmark_ids=rng.permutation(5 * n)[:n].astype(np.int64), sightings=rng.integers(3, 400, n).astype(np.int32),
        descriptors=descriptors, path=path, follows_previous=True, session=2,
    )  # fmt: skip


@pytest.fixture
def make_submap() -> Callable[..., Submap]:
    return made
