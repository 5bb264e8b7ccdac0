# SPDX-License-Identifier: Apache-2.0
"""The moment at which an agent's camera had a place in view, by the paths of all agents."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.trajectory import Trajectory

_NEAREST_M, _FARTHEST_M = 0.4, 6.0
_HALF_VIEW = np.cos(np.radians(30.0))
"""Cosine of the angle from the rig's X axis up to which a place counts as in view."""


def moment_of(paths: Mapping[str, Trajectory], point: FloatArray) -> tuple[str, int]:
    """Agent and stamp (ns) of the pose that looked along its X axis at a point (3,) m of the map from least far.

    If none did: of the pose that was nearest. Walls between are not known here.

    Raises
    ------
    ValueError
        If the point is not finite, or there is no path.
    """
    if not np.isfinite(point).all():
        raise ValueError(f"a place with coordinates {point.tolist()} m cannot be")
    candidates = []
    for agent, path in sorted(paths.items()):
        for stamp, T in zip(path.stamps_ns, path.poses, strict=True):
            ray = point - T[:3, 3]
            distance = float(np.linalg.norm(ray))
            in_view = _NEAREST_M <= distance <= _FARTHEST_M and float(ray @ T[:3, 0]) >= _HALF_VIEW * distance
            candidates.append((not in_view, distance, agent, int(stamp)))
    if not candidates:
        raise ValueError("no agent has a path in the map yet")
    _, _, agent, stamp = min(candidates)
    return agent, stamp
