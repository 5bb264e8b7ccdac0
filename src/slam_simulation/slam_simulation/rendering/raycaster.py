# SPDX-License-Identifier: Apache-2.0
"""Tiled ray caster over rectangles: the surface that each pixel sees.

All geometry is brought into the camera's frame once per view, where pixel rays are fixed. The image is cut into tiles
of 16 x 16 pixels; each tile keeps only the rectangles that its pyramid of rays can meet, nearest first, and drops
those behind one that covers the tile entirely. A pixel then tests a handful of rectangles instead of hundreds. Tiles
are independent, so the result does not depend on how many threads work on them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.camera import Camera
from slam_core.geometry import FloatArray, invert_transform
from slam_core.types import Float32Array
from slam_simulation.world.surface_table import SurfaceTable

TILE = 16
NEAR = 0.02
"""Nothing nearer than this (m) is drawn."""
SEAM = 1e-6
"""Rectangles reach this share of their size beyond their edges, so that no ray slips between two that touch."""


class Rays(NamedTuple):
    """The rays of a camera, made once.

    rays: float32 (h, w, 6) = x/z, y/z of the pixel's centre and their derivatives along u and along v. bounds: float64
    (tile rows, tile columns, 4) = least and greatest x/z, y/z over each tile, half a pixel of margin included.
    """

    rays: Float32Array
    bounds: FloatArray


def camera_rays(camera: Camera) -> Rays:
    """Rays of all pixels of ``camera``, lens distortion included: exact, not resampled."""
    h, w = camera.height, camera.width
    v, u = np.meshgrid(np.arange(-1.0, h + 1), np.arange(-1.0, w + 1), indexing="ij")
    xy = camera.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()])).reshape(h + 2, w + 2, 2)
    along_u, along_v = (xy[1:-1, 2:] - xy[1:-1, :-2]) / 2, (xy[2:, 1:-1] - xy[:-2, 1:-1]) / 2
    rays = np.concatenate([xy[1:-1, 1:-1], along_u, along_v], axis=-1).astype(np.float32)
    rows, columns = -(-h // TILE), -(-w // TILE)
    bounds = np.empty((rows, columns, 4))
    for i in range(rows):
        for j in range(columns):
            part = xy[i * TILE : (i + 1) * TILE + 2, j * TILE : (j + 1) * TILE + 2].reshape(-1, 2)
            bounds[i, j] = [part[:, 0].min(), part[:, 0].max(), part[:, 1].min(), part[:, 1].max()]
    return Rays(rays, bounds)


class View(NamedTuple):
    """The visible part of a world in the frame of one camera.

    planes: (m, 9) = normal / distance (so that 1/z = planes[:3] . (x, y, 1)), edge_u / |edge_u|^2, edge_v / |edge_v|^2;
    shifts: (m, 2) the edges' products with the origin; corners: (m, 4, 3); near: (m,) least z; ids: (m,) rows of the
    world.
    """

    planes: FloatArray
    shifts: FloatArray
    corners: FloatArray
    near: FloatArray
    ids: npt.NDArray[np.int64]


def make_view(world: SurfaceTable, T_world_camera: FloatArray, bounds: FloatArray) -> View:
    """Bring the surfaces that face the camera and meet its field of view into the camera's frame."""
    T = invert_transform(T_world_camera)
    R, t = T[:3, :3], T[:3, 3]
    facing = np.flatnonzero(((T_world_camera[:3, 3] - world.origin) * world.normal).sum(axis=1) > 1e-6)
    p, eu, ev = world.origin[facing] @ R.T + t, world.edge_u[facing] @ R.T, world.edge_v[facing] @ R.T
    corners = np.stack([p, p + eu, p + eu + ev, p + ev], axis=1)
    limits = [bounds[..., 0].min(), bounds[..., 1].max(), bounds[..., 2].min(), bounds[..., 3].max()]
    x, y, z = np.moveaxis(corners, -1, 0)
    outside = [z <= NEAR, x <= limits[0] * z, x >= limits[1] * z, y <= limits[2] * z, y >= limits[3] * z]
    seen = ~np.any([o.all(axis=1) for o in outside], axis=0)
    p, eu, ev, corners, ids = p[seen], eu[seen], ev[seen], corners[seen], facing[seen]
    normal = world.normal[ids] @ R.T
    eu, ev = eu / (eu * eu).sum(axis=1, keepdims=True), ev / (ev * ev).sum(axis=1, keepdims=True)
    planes = np.concatenate([normal / (normal * p).sum(axis=1, keepdims=True), eu, ev], axis=1)
    shifts = np.column_stack([(eu * p).sum(axis=1), (ev * p).sum(axis=1)])
    near = np.maximum(corners[..., 2].min(axis=1), NEAR)
    return View(planes, shifts, np.ascontiguousarray(corners), near, ids)


class Hits(NamedTuple):
    """Result of :func:`trace`.

    surface: int32 (h, w), row of the *view* or -1. depth: float32 (h, w), z in m, 0 where nothing is hit. candidates:
    int32 (tiles, m), each tile's rectangles nearest first; counts: int32 (tiles,).
    """

    surface: npt.NDArray[np.int32]
    depth: Float32Array
    candidates: npt.NDArray[np.int32]
    counts: npt.NDArray[np.int32]


def trace(view: View, rays: Rays, pool: ThreadPoolExecutor | None = None) -> Hits:
    """First surface along every pixel's ray."""
    h, w = rays.rays.shape[:2]
    rows, columns = rays.bounds.shape[:2]
    hits = Hits(
        np.full((h, w), -1, np.int32),
        np.zeros((h, w), np.float32),
        np.empty((rows * columns, len(view.ids)), np.int32),
        np.zeros(rows * columns, np.int32),
    )
    for_tile_rows(
        rows,
        pool,
        lambda first, last: _trace_rows(
            first, last, rays.rays, rays.bounds, view.planes, view.shifts, view.corners, view.near, *hits
        ),
    )
    return hits


def for_tile_rows(rows: int, pool: ThreadPoolExecutor | None, work: Callable[[int, int], Any]) -> None:
    """Call ``work(first, last)`` over bands of tile rows, in the threads of ``pool``."""
    if pool is None:
        work(0, rows)
        return
    for future in [pool.submit(work, i, min(i + 5, rows)) for i in range(0, rows, 5)]:
        future.result()


@njit(cache=True, nogil=True, error_model="numpy")
def meet(
    x: float, y: float, planes: FloatArray, shifts: FloatArray, q: int
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Depth z and place (u, v) in rectangle ``q`` where the ray (x, y, 1) meets it; z < 0 behind or outside."""
    inverse = planes[q, 0] * x + planes[q, 1] * y + planes[q, 2]
    if inverse <= 1e-9:
        return -1.0, 0.0, 0.0
    z = 1.0 / inverse
    u = z * (planes[q, 3] * x + planes[q, 4] * y + planes[q, 5]) - shifts[q, 0]
    v = z * (planes[q, 6] * x + planes[q, 7] * y + planes[q, 8]) - shifts[q, 1]
    if u < -SEAM or u > 1.0 + SEAM or v < -SEAM or v > 1.0 + SEAM or z < NEAR:
        return -1.0, u, v
    return z, u, v


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(
    x: float,
    y: float,
    candidates: npt.NDArray[np.int32],
    count: int,
    tile: int,
    planes: FloatArray,
    shifts: FloatArray,
    near: FloatArray,
) -> tuple[int, float, float, float]:  # pragma: no cover - compiled
    """Nearest of a tile's first ``count`` rectangles along the ray (x, y, 1): row of the view or -1, z, u, v."""
    best, best_z, best_u, best_v = -1, 1e30, 0.0, 0.0
    for k in range(count):
        q = candidates[tile, k]
        if near[q] >= best_z:
            break
        z, u, v = meet(x, y, planes, shifts, q)
        if 0.0 < z < best_z:
            best, best_z, best_u, best_v = q, z, u, v
    return best, best_z, best_u, best_v


@njit(cache=True, nogil=True, error_model="numpy")
def _cull(
    bound: FloatArray,
    planes: FloatArray,
    shifts: FloatArray,
    corners: FloatArray,
    near: FloatArray,
    out: npt.NDArray[np.int32],
) -> int:  # pragma: no cover - compiled
    """Fill ``out`` with the rectangles a tile can see, nearest first; returns their number."""
    x0, x1, y0, y1 = bound[0], bound[1], bound[2], bound[3]
    count = 0
    cover = 1e30
    for q in range(planes.shape[0]):
        left = right = above = below = behind = 0
        for c in range(4):
            x, y, z = corners[q, c, 0], corners[q, c, 1], corners[q, c, 2]
            left += x < x0 * z
            right += x > x1 * z
            above += y < y0 * z
            below += y > y1 * z
            behind += z < NEAR
        if left == 4 or right == 4 or above == 4 or below == 4 or behind == 4:
            continue
        farthest = 0.0
        for c in range(4):
            z, _, _ = meet(x0 if c % 2 == 0 else x1, y0 if c < 2 else y1, planes, shifts, q)
            farthest = 1e30 if z <= 0.0 else max(farthest, z)
        cover = min(cover, farthest)
        k = count
        while k > 0 and near[out[k - 1]] > near[q]:
            out[k] = out[k - 1]
            k -= 1
        out[k] = q
        count += 1
    # A wall seen straight on is as near as it is far: rounding must not let it hide itself.
    while count > 0 and near[out[count - 1]] > cover * (1.0 + 1e-9):
        count -= 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_rows(
    first: int,
    last: int,
    rays: Float32Array,
    bounds: FloatArray,
    planes: FloatArray,
    shifts: FloatArray,
    corners: FloatArray,
    near: FloatArray,
    surface: npt.NDArray[np.int32],
    depth: Float32Array,
    candidates: npt.NDArray[np.int32],
    counts: npt.NDArray[np.int32],
) -> None:  # pragma: no cover - compiled
    height, width = surface.shape
    columns = bounds.shape[1]
    for row in range(first, last):
        for column in range(columns):
            tile = row * columns + column
            counts[tile] = _cull(bounds[row, column], planes, shifts, corners, near, candidates[tile])
            for i in range(row * TILE, min((row + 1) * TILE, height)):
                for j in range(column * TILE, min((column + 1) * TILE, width)):
                    q, z, _, _ = nearest(
                        rays[i, j, 0], rays[i, j, 1], candidates, counts[tile], tile, planes, shifts, near
                    )
                    if q >= 0:
                        surface[i, j] = q
                        depth[i, j] = z
