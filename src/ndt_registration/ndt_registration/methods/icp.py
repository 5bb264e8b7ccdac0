# SPDX-License-Identifier: Apache-2.0
"""Iterative closest points, point to point and point to plane: kd-tree, trimmed, with a rejection limit that shrinks.

Kept as the baseline that the thesis compares with (10.2) and for clouds too thin for cells of points. One setting
serves large motions because the limit starts at a fraction of the cloud's scale and shrinks to a few point spacings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from slam_core.config import Config, parameter
from slam_core.estimation.rigid_alignment import umeyama
from slam_core.geometry import FloatArray, boxplus, make_transform, transform_points

_RELATIVE_MAX_DISTANCE = 0.2
"""First rejection limit over the scale."""
_SHRINKAGE = 0.6
"""Factor of the limit from stage to stage."""
_ITERATIONS = 20
"""Most iterations per stage before the last limit is reached, where the next stage goes on."""
_LAST_ITERATIONS = 150
"""Most iterations with the last limit: points against points slide along surfaces by small steps."""
_TOLERANCE = 1e-4
"""Length of the last step, over the scale."""
_NEIGHBOURS = 12
"""Neighbours from which a normal is computed."""


@dataclass(frozen=True)
class IcpConfig(Config):
    """Iterative closest points."""

    max_distance: float = parameter(0.0, "first rejection limit, 0: from the cloud's scale", unit="m", minimum=0.0)
    final_spacings: float = 3.0
    """Last rejection limit over the median spacing of the target."""
    trimmed: float = 0.9
    """Share of the pairs within the limit that is used, nearest first."""


_FLAT = 1e-9
"""Height of a cloud over its extent below which it lies in the plane."""


class IcpOutcome(NamedTuple):
    """Pose T_target_source, iterations, whether the last stage's steps became small."""

    T: FloatArray
    iterations: int
    converged: bool


class IcpTarget:
    """kd-tree, spacing and normals of a cloud (n, 3), each place once: a tree cannot part points that coincide."""

    def __init__(self, points: FloatArray) -> None:
        points = points[np.sort(np.unique(points, axis=0, return_index=True)[1])]
        self.points = points
        self.tree = cKDTree(points)
        distances, self._neighbours = self.tree.query(points, k=min(_NEIGHBOURS, len(points)))
        self.spacing = float(np.median(distances[:, 1]))
        self._normals: FloatArray | None = None

    @property
    def normals(self) -> FloatArray:
        """Unit normal of each point (n, 3): direction of least variance among its neighbours."""
        if self._normals is None:
            patches = self.points[self._neighbours]
            patches = patches - patches.mean(axis=1, keepdims=True)
            # In the plane every normal lies in it: without z, whose variance is the least of all, as it is zero.
            extent = np.ptp(self.points, axis=0)
            axes = 3 if extent[2] > _FLAT * extent.max() else 2
            moments = np.einsum("nki,nkj->nij", patches[:, :, :axes], patches[:, :, :axes])
            self._normals = np.zeros_like(self.points)
            self._normals[:, :axes] = np.linalg.eigh(moments)[1][:, :, 0]
        return self._normals


def icp_align(
    source: FloatArray,
    target: IcpTarget,
    T: FloatArray,
    scale: float,
    config: IcpConfig,
    *,
    coarse_points: int,
    plane: bool,
    planar: bool,
) -> IcpOutcome:
    """Move ``source`` (n, 3), in random order, onto ``target`` from the pose ``T``.

    ``coarse_points`` of them are used until the last rejection limit is reached and the steps have become small with
    it, then all. ``planar`` allows x, y and yaw only.
    """
    limit = config.max_distance or _RELATIVE_MAX_DISTANCE * scale
    last = min(config.final_spacings * target.spacing, limit)
    stages = [(source[:coarse_points], last, _LAST_ITERATIONS), (source, last, _LAST_ITERATIONS)]
    while limit > last:
        stages.insert(-2, (source[:coarse_points], limit, _ITERATIONS))
        limit *= _SHRINKAGE
    iterations, converged = 0, False
    for points, limit, most in stages:
        T, used, converged = _stage(points, target, T, limit, most, scale, config, plane, planar)
        iterations += used
    return IcpOutcome(T, iterations, converged)


def _stage(
    source: FloatArray,
    target: IcpTarget,
    T: FloatArray,
    limit: float,
    most: int,
    scale: float,
    config: IcpConfig,
    plane: bool,
    planar: bool,
) -> tuple[FloatArray, int, bool]:
    """At most so many iterations with one rejection limit: pose, number, whether the steps became small."""
    for iteration in range(1, most + 1):
        moved = transform_points(T, source)
        distance, nearest = target.tree.query(moved, distance_upper_bound=limit)
        pairs = np.flatnonzero(np.isfinite(distance))
        if len(pairs) < 6:
            return T, iteration, False
        keep = max(int(config.trimmed * len(pairs)), 6)
        pairs = pairs[np.argpartition(distance[pairs], keep - 1)[:keep]]
        points, matches = moved[pairs], nearest[pairs]
        if plane:
            step = _plane_step(points, T[:3, 3], target.points[matches], target.normals[matches], planar)
            T_new = boxplus(T, step)
        else:
            T_new = _point_step(points, target.points[matches], planar) @ T
        change = np.linalg.norm(T_new[:3, 3] - T[:3, 3]) + scale * np.linalg.norm(T_new[:3, :3] - T[:3, :3])
        T = T_new
        if change < _TOLERANCE * scale:
            return T, iteration, True
    return T, most, False


def _point_step(points: FloatArray, matches: FloatArray, planar: bool) -> FloatArray:
    """Rigid motion that brings the points nearest to their matches."""
    if not planar:
        return umeyama(points, matches)
    a, b = points - points.mean(axis=0), matches - matches.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return make_transform(R, matches.mean(axis=0) - R @ points.mean(axis=0))


def _plane_step(
    points: FloatArray, translation: FloatArray, matches: FloatArray, normals: FloatArray, planar: bool
) -> FloatArray:
    """Gauss-Newton step (6,) of the distances along the normals."""
    residual = np.einsum("ni,ni->n", points - matches, normals)
    J = np.hstack([normals, np.cross(points - translation, normals)])
    if planar:
        J[:, 2:5] = 0.0
    A = J.T @ J
    return -np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(6), J.T @ residual)
