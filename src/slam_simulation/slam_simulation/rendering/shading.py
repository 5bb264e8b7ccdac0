# SPDX-License-Identifier: Apache-2.0
"""Radiance of the traced image: filtered textures, baked light, highlights, smooth edges.

Textures are averaged over the parallelogram that a pixel's ray derivatives span on the surface. Pixels at the border of
surfaces are shared out among them by 4 x 4 rays, and each surface is shaded once.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.types import ByteArray, Float32Array
from slam_simulation.rendering.pixel_surfaces import EDGE_RAYS, place_on_surface, surfaces_of_pixel
from slam_simulation.rendering.raycaster import TILE, Hits, Rays, View, for_tile_rows
from slam_simulation.rendering.texture_sampling import interpolate, sample_texture, trilinear
from slam_simulation.world.surface_table import Look, SurfaceTable

SHININESS = 80.0
SHIFT_U, SHIFT_V, SCALE_U, SCALE_V = Look.SHIFT_U, Look.SHIFT_V, Look.SCALE_U, Look.SCALE_V
OVERLAY_U, OVERLAY_V, OVERLAY_SCALE_U = Look.OVERLAY_U, Look.OVERLAY_V, Look.OVERLAY_SCALE_U
OVERLAY_SCALE_V, OVERLAY_GAIN = Look.OVERLAY_SCALE_V, Look.OVERLAY_GAIN
BRIGHTNESS, GLOSS, EMISSION = Look.BRIGHTNESS, Look.GLOSS, Look.EMISSION


def render(
    world: SurfaceTable,
    view: View,
    rays: Rays,
    hits: Hits,
    T_world_camera: FloatArray,
    pool: ThreadPoolExecutor | None = None,
) -> Float32Array:
    """Radiance image, float32 (h, w), relative units: a white wall in good light is about 1."""
    image = np.zeros(hits.surface.shape, np.float32)
    lamps = world.lamps.copy()
    lamps[:, :3] = transform_points(invert_transform(T_world_camera), lamps[:, :3])
    for_tile_rows(
        rays.bounds.shape[0],
        pool,
        lambda first, last: _render_rows(first, last, world, view, rays, hits, lamps, image),
    )
    return image


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def surface_light(
    light: Float32Array, lookup: npt.NDArray[np.int64], w: int, u: float, v: float
) -> float:  # pragma: no cover - compiled
    """Baked irradiance at (u, v) of surface ``w``, bilinear between the nodes."""
    columns, rows = lookup[w, 3], lookup[w, 4]
    x, y = u * (columns - 1), v * (rows - 1)
    x0, y0 = min(int(x), columns - 2), min(int(y), rows - 2)
    ax, ay = x - x0, y - y0
    k = lookup[w, 2] + y0 * columns + x0
    return interpolate(light, k, k + 1, k + columns, k + columns + 1, ax, ay)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def reflectance(
    look: FloatArray,
    lookup: npt.NDArray[np.int64],
    texels: ByteArray,
    index: npt.NDArray[np.int64],
    w: int,
    u: float,
    v: float,
    au: float,
    av: float,
    bu: float,
    bv: float,
) -> float:  # pragma: no cover - compiled
    """Diffuse reflectance of surface ``w`` over a footprint in its own (u, v)."""
    su, sv = look[w, SCALE_U], look[w, SCALE_V]
    tu, tv = look[w, SHIFT_U] + su * u, look[w, SHIFT_V] + sv * v
    value = sample_texture(texels, index, lookup[w, 0], tu, tv, su * au, sv * av, su * bu, sv * bv)
    overlay = lookup[w, 1]
    if overlay >= 0:
        su, sv = look[w, OVERLAY_SCALE_U], look[w, OVERLAY_SCALE_V]
        size = np.sqrt(abs((au * bv - av * bu) * su * sv)) * (1 << index[overlay, 1])
        # The overlay is smooth: the nearest level of the mip chain will do.
        level = np.floor(np.log2(size) + 0.5) if size > 1.0 else 0.0
        layer = trilinear(texels, index, overlay, look[w, OVERLAY_U] + su * u, look[w, OVERLAY_V] + sv * v, level)
        value *= 1.0 + look[w, OVERLAY_GAIN] * (layer - 0.5)
    return float(value * look[w, BRIGHTNESS])


@njit(cache=True, nogil=True, error_model="numpy")
def _highlight(
    lamps: FloatArray, room: int, planes: FloatArray, q: int, x: float, y: float, z: float
) -> float:  # pragma: no cover - compiled
    """Mirror-like reflection of the room's lamps (Blinn 1977), which moves with the camera."""
    nx, ny, nz = planes[q, 0], planes[q, 1], planes[q, 2]
    scale = -1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    view = 1.0 / np.sqrt(x * x + y * y + 1.0)
    total = 0.0
    for k in range(lamps.shape[0]):
        if lamps[k, 4] != room:
            continue
        lx, ly, lz = lamps[k, 0] - x * z, lamps[k, 1] - y * z, lamps[k, 2] - z
        distance_sq = lx * lx + ly * ly + lz * lz
        inverse = 1.0 / np.sqrt(distance_sq)
        hx, hy, hz = lx * inverse - x * view, ly * inverse - y * view, lz * inverse - view
        length = np.sqrt(hx * hx + hy * hy + hz * hz)
        cosine = scale * (nx * hx + ny * hy + nz * hz) / max(length, 1e-9)
        if cosine > 0.9:
            total += lamps[k, 3] / distance_sq * np.exp(SHININESS * np.log(cosine))
    return float(total)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _radiance(
    x: float,
    y: float,
    q: int,
    w: int,
    i: int,
    j: int,
    rays: Float32Array,
    planes: FloatArray,
    shifts: FloatArray,
    look: FloatArray,
    lookup: npt.NDArray[np.int64],
    light: Float32Array,
    texels: ByteArray,
    index: npt.NDArray[np.int64],
    lamps: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Radiance of surface ``w`` (row ``q`` of the view) along the ray (x, y, 1), over the footprint of pixel (i, j)."""
    p = planes
    z, u, v = place_on_surface(planes, shifts, q, x, y)
    xu, yu, xv, yv = rays[i, j, 2], rays[i, j, 3], rays[i, j, 4], rays[i, j, 5]
    # u = z (e . r) - shift and z = 1 / (n . r), so du = z e . dr - z^2 (n . dr) (e . r).
    e1, e2 = p[q, 3] * x + p[q, 4] * y + p[q, 5], p[q, 6] * x + p[q, 7] * y + p[q, 8]
    na, nb = z * z * (p[q, 0] * xu + p[q, 1] * yu), z * z * (p[q, 0] * xv + p[q, 1] * yv)
    au, av = z * (p[q, 3] * xu + p[q, 4] * yu) - na * e1, z * (p[q, 6] * xu + p[q, 7] * yu) - na * e2
    bu, bv = z * (p[q, 3] * xv + p[q, 4] * yv) - nb * e1, z * (p[q, 6] * xv + p[q, 7] * yv) - nb * e2
    value = reflectance(look, lookup, texels, index, w, u, v, au, av, bu, bv)
    value *= surface_light(light, lookup, w, u, v) + look[w, EMISSION]
    gloss = look[w, GLOSS]
    if gloss > 0.0:
        value += gloss * _highlight(lamps, lookup[w, 5], p, q, x, y, z)
    return float(value)


@njit(cache=True, nogil=True, error_model="numpy")
def _render_rows(
    first: int,
    last: int,
    world: SurfaceTable,
    view: View,
    all_rays: Rays,
    hits: Hits,
    lamps: FloatArray,
    image: Float32Array,
) -> None:  # pragma: no cover - compiled
    # Arrays are taken out of the tuples once, and what is called per pixel is inlined: handing so many arguments on
    # costs more than the shading.
    surface, candidates, counts = hits.surface, hits.candidates, hits.counts
    rays, planes, shifts, near, ids = all_rays.rays, view.planes, view.shifts, view.near, view.ids
    look, lookup, light = world.look, world.lookup, world.light
    texels, index = world.textures.texels, world.textures.entries
    height, width = image.shape
    columns = all_rays.bounds.shape[1]
    parts = np.empty((EDGE_RAYS * EDGE_RAYS, 4))
    for i in range(first * TILE, min(last * TILE, height)):
        for j in range(width):
            tile = (i // TILE) * columns + j // TILE
            found = surfaces_of_pixel(i, j, tile, rays, surface, candidates, counts, planes, shifts, near, parts)
            for m in range(found):
                q, x, y = int(parts[m, 0]), parts[m, 2], parts[m, 3]
                image[i, j] += parts[m, 1] * _radiance(
                    x, y, q, ids[q], i, j, rays, planes, shifts, look, lookup, light, texels, index, lamps
                )
