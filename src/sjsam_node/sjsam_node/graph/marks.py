# SPDX-License-Identifier: Apache-2.0
"""Finds that somebody marks in the map.

A mark hangs on the nearest pose of the skeleton and moves with it at a closure.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class Mark:
    """A named point (3,) in the frame of a node."""

    name: str
    node: int
    point: FloatArray


@dataclass
class Marks:
    """All marks of a map."""

    marks: list[Mark] = field(default_factory=list)

    def add(
        self, poses: FloatArray, point: FloatArray, name: str = "", where: npt.NDArray[np.bool_] | None = None
    ) -> Mark:
        """Mark a point (3,) of the map frame, m, where the map's nodes are at ``poses`` (n, 4, 4).

        ``where``: mask (n,) of the nodes that it may hang on, by default all.

        Raises
        ------
        ValueError
            If the map is empty or the point is not finite.
        """
        if not len(poses):
            raise ValueError("nothing can be marked in an empty map")
        if point.shape != (3,) or not np.all(np.isfinite(point)):
            raise ValueError(f"a mark needs three finite coordinates in m, got {point}")
        distance = np.linalg.norm(poses[:, :3, 3] - point, axis=1)
        node = int(np.argmin(distance if where is None else np.where(where, distance, np.inf)))
        T = poses[node]
        mark = Mark(name or f"mark {len(self.marks) + 1}", node, T[:3, :3].T @ (point - T[:3, 3]))
        self.marks.append(mark)
        return mark

    def positions(self, poses: FloatArray) -> FloatArray:
        """Marks in the map frame, (n, 3) m, where the map's nodes are at ``poses`` (n, 4, 4)."""
        return np.array([poses[m.node, :3, :3] @ m.point + poses[m.node, :3, 3] for m in self.marks]).reshape(-1, 3)
