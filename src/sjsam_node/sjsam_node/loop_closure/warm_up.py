# SPDX-License-Identifier: Apache-2.0
"""Work like that of a live map, on a problem of a few landmarks: a worker loads all kernels by it before its first."""

from __future__ import annotations

import numpy as np

from sjsam_node.graph.links import Prior
from sjsam_node.joint_problem.problem import JoiningState, LocalMap, flatten
from sjsam_node.loop_closure.association import PointSet
from sjsam_node.loop_closure.verification import Verifier
from sjsam_node.smoothing.submap_joining import Elimination, marginal

_LANDMARKS = 12


def warm_up() -> None:
    """Compare a submap with itself, and join three that stand at one place."""
    rng = np.random.default_rng(1)
    points, looks = rng.normal(size=(_LANDMARKS, 3)), np.eye(_LANDMARKS, 128, dtype=np.float32)
    seen = PointSet(points, 1e-4 * np.eye(3 * _LANDMARKS), looks)
    verifier = Verifier()
    verifier.verify(seen, seen, Prior(np.eye(4), 1e-2 * np.eye(6)), 1.0, 0, 1)
    verifier.verify(seen, seen, None, 1.0, 0, 1)
    every, rows = np.arange(_LANDMARKS), 6 + 3 * _LANDMARKS
    maps = [LocalMap(k, np.array([k + 1]), every, np.append(np.zeros(6), points), np.eye(rows)) for k in range(3)]
    state = JoiningState(np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)), points)
    reference, separator = np.array([0]), np.array([3])
    last = np.concatenate([separator, 4 + every])
    marginal(Elimination(flatten(maps), state, reference, last, 0.0, separator, every, reference, state))
