# SPDX-License-Identifier: Apache-2.0
"""The ray caster against a plain NumPy one, and the camera's own projection."""

import numpy as np
import pytest

from slam_core.camera import Camera
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform, rotation_from_euler
from slam_simulation import Simulator
from slam_simulation.rendering.raycaster import TILE, camera_rays, make_view, trace
from slam_simulation.world.surface_table import SurfaceTable

WIDE = Camera(97, 75, 45.0, 45.0, 48.0, 37.0, "plumb_bob", (-0.2, 0.04, 0.001, -0.002, 0.0))


def looking(x: float, y: float, z: float, yaw: float, pitch: float) -> FloatArray:
    rotation = rotation_from_euler(yaw, pitch) @ OPTICAL_FROM_RIG.T
    return make_transform(rotation, np.array([x, y, z]))


def brute_force(world: SurfaceTable, T: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Depth along z and surface of every pixel, by testing every rectangle."""
    v, u = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    xy = camera.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T[:3, :3].T
    along = rays @ world.normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = ((world.origin - T[:3, 3]) * world.normal).sum(axis=1) / along
    z = np.where((along < 0) & (z > 0.02), z, np.inf)
    depth, surface = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for q in range(len(world.origin)):
        hit = T[:3, 3] + rays * np.where(np.isfinite(z[:, q]), z[:, q], 0.0)[:, None] - world.origin[q]
        inside = np.isfinite(z[:, q])
        for edge in (world.edge_u[q], world.edge_v[q]):
            part = hit @ edge / (edge @ edge)
            inside &= (part >= 0) & (part <= 1)
        nearer = inside & (z[:, q] < depth)
        depth[nearer], surface[nearer] = z[nearer, q], q
    shape = (camera.height, camera.width)
    return depth.reshape(shape), surface.reshape(shape)


@pytest.mark.parametrize(
    "pose",
    [(1.5, 1.5, 1.3, 0.3, 0.0), (2.6, 1.2, 1.7, 2.5, 0.5), (0.6, 3.3, 0.9, -0.9, -0.7), (1.5, 1.4, 1.35, 0.0, 0.0)],
)
def test_finds_what_testing_every_rectangle_finds(simulator: Simulator, pose: tuple[float, ...]) -> None:
    T = looking(*pose)
    rays = camera_rays(WIDE)
    view = make_view(simulator.world, T, rays.bounds)
    hits = trace(view, rays)
    depth, surface = brute_force(simulator.world, T, WIDE)
    found = np.where(hits.surface >= 0, view.ids[hits.surface], -1)
    # A ray through the common edge of two surfaces may go to either.
    assert (found == surface).mean() > 0.9995
    same = found == surface
    np.testing.assert_allclose(hits.depth[same], depth[same], rtol=1e-5)


def test_rays_are_the_inverse_of_the_projection() -> None:
    rays = camera_rays(WIDE).rays
    v, u = np.meshgrid(np.arange(WIDE.height), np.arange(WIDE.width), indexing="ij")
    points = np.dstack([rays[..., 0], rays[..., 1], np.ones_like(u)]).reshape(-1, 3)
    np.testing.assert_allclose(WIDE.project(points), np.column_stack([u.ravel(), v.ravel()]), atol=2e-4)


def test_ray_derivatives_lead_to_the_next_pixel() -> None:
    rays = camera_rays(WIDE).rays
    middle = (rays[:, 2:, :2] - rays[:, :-2, :2]) / 2
    np.testing.assert_allclose(rays[:, 1:-1, 2:4], middle, atol=1e-5)
    middle = (rays[2:, :, :2] - rays[:-2, :, :2]) / 2
    np.testing.assert_allclose(rays[1:-1, :, 4:6], middle, atol=1e-5)


def test_tile_bounds_hold_all_rays_of_the_tile() -> None:
    rays = camera_rays(WIDE)
    for i in range(rays.bounds.shape[0]):
        for j in range(rays.bounds.shape[1]):
            part = rays.rays[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE]
            x0, x1, y0, y1 = rays.bounds[i, j]
            assert x0 < part[..., 0].min()
            assert part[..., 0].max() < x1
            assert y0 < part[..., 1].min()
            assert part[..., 1].max() < y1
