# SPDX-License-Identifier: Apache-2.0
"""Distances of points from the surfaces of a world, and the surfaces that a camera has seen: truth for models."""

from __future__ import annotations

import numpy as np

from slam_core.camera import Camera
from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_simulation.rendering.raycaster import camera_rays, make_view, trace
from slam_simulation.world.surface_table import SurfaceTable
from slam_simulation.world.world import World


def distance_to_surfaces(world: World, points: FloatArray) -> FloatArray:
    """Distance (n,) m of points (n, 3), world frame, to the nearest rectangle of the world."""
    nearest = np.full(len(points), np.inf)
    for surface in world.surfaces:
        relative = points - surface.origin
        across = np.abs(relative @ surface.normal)
        near = np.flatnonzero(across < nearest)
        outside = np.zeros(len(near))
        for edge in (surface.edge_u, surface.edge_v):
            length = np.linalg.norm(edge)
            along = relative[near] @ (edge / length)
            outside += np.square(np.maximum(np.maximum(-along, along - length), 0.0))
        nearest[near] = np.minimum(nearest[near], np.sqrt(np.square(across[near]) + outside))
    return nearest


def sample_surfaces(world: World, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) m on all rectangles, about ``spacing`` apart, and their normals (n, 3)."""
    points, normals = [], []
    for surface in world.surfaces:
        counts = [max(1, round(length / spacing)) for length in surface.size]
        u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij")
        points.append(surface.origin + u.reshape(-1, 1) * surface.edge_u + v.reshape(-1, 1) * surface.edge_v)
        normals.append(np.tile(surface.normal, (u.size, 1)))
    return np.concatenate(points), np.concatenate(normals)


def count_sightings(
    world: SurfaceTable,
    points: FloatArray,
    normals: FloatArray,
    camera: Camera,
    poses: FloatArray,
    max_depth: float,
    max_incidence_deg: float = 75.0,
) -> FloatArray:
    """Number of the cameras at ``poses`` T_world_camera (m, 4, 4) that see each point (n, 3), near and not hidden."""
    rays = camera_rays(camera)
    seen = np.zeros(len(points))
    for T in poses:
        depth = trace(make_view(world, T, rays.bounds), rays).depth
        local = transform_points(invert_transform(T), points)
        direction = T[:3, 3] - points
        towards = (direction * normals).sum(axis=1) / np.linalg.norm(direction, axis=1)
        candidates = (local[:, 2] > 0.1) & (local[:, 2] < max_depth) & (towards > np.cos(np.radians(max_incidence_deg)))
        index = np.flatnonzero(candidates)
        pixels = camera.project(local[index])
        inside = ((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=1)
        index, pixels = index[inside], np.rint(pixels[inside]).astype(int)
        z = local[index, 2]
        seen[index[np.abs(depth[pixels[:, 1], pixels[:, 0]] - z) < 0.02 + 0.02 * z]] += 1.0
    return seen
