"""What does a pixel see? Radiance of the traced image: filtered textures, baked light, highlights, smooth edges.

A pixel's footprint on a surface is the parallelogram that its ray derivatives span. The texture is read along the longer
side with several trilinear samples of the level that fits the shorter one (Heckbert 1989): sharp where a wall recedes, and
still free of aliasing. Pixels at the border of two surfaces are averaged over 4 x 4 rays.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.geometry import FloatArray, invert_transform, transform_points
from slam_core.simulation.raycaster import TILE, Hits, Rays, View, for_tile_rows, nearest
from slam_core.simulation.surface_table import Look, SurfaceTable
from slam_core.types import ByteArray, Float32Array

EDGE_RAYS = 4
MAX_SAMPLES = 6
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


@njit(cache=True, nogil=True, error_model="numpy")
def _bilinear(
    texels: ByteArray, offset: int, width: int, height: int, clamp: int, u: float, v: float
) -> float:  # pragma: no cover - compiled
    """Texture value 0 to 255 at (u, v), in repetitions, of one level."""
    x, y = u * width - 0.5, v * height - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    x0, y0 = int(fx), int(fy)
    x1, y1 = x0 + 1, y0 + 1
    if clamp:
        x0, x1 = min(max(x0, 0), width - 1), min(max(x1, 0), width - 1)
        y0, y1 = min(max(y0, 0), height - 1), min(max(y1, 0), height - 1)
    else:
        x0, x1, y0, y1 = x0 & (width - 1), x1 & (width - 1), y0 & (height - 1), y1 & (height - 1)
    top, bottom = offset + y0 * width, offset + y1 * width
    upper = texels[top + x0] * (1.0 - ax) + texels[top + x1] * ax
    lower = texels[bottom + x0] * (1.0 - ax) + texels[bottom + x1] * ax
    return upper * (1.0 - ay) + lower * ay


@njit(cache=True, nogil=True, error_model="numpy")
def _trilinear(
    texels: ByteArray, index: npt.NDArray[np.int64], t: int, u: float, v: float, level: float
) -> float:  # pragma: no cover - compiled
    """Value 0 to 1 of texture ``t`` at (u, v) of a level between two of the mip chain."""
    offset, width, height, clamp = index[t, 0], 1 << index[t, 1], 1 << index[t, 2], index[t, 3]
    top = max(index[t, 1], index[t, 2])
    level = min(max(level, 0.0), float(top))
    whole = int(level)
    for _ in range(whole):
        offset += width * height
        width, height = max(width >> 1, 1), max(height >> 1, 1)
    value = _bilinear(texels, offset, width, height, clamp, u, v)
    part = level - whole
    if part > 0.01 and whole < top:
        offset += width * height
        coarse = _bilinear(texels, offset, max(width >> 1, 1), max(height >> 1, 1), clamp, u, v)
        value += part * (coarse - value)
    return float(value * (1.0 / 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def sample_texture(
    texels: ByteArray,
    index: npt.NDArray[np.int64],
    t: int,
    u: float,
    v: float,
    au: float,
    av: float,
    bu: float,
    bv: float,
) -> float:  # pragma: no cover - compiled
    """Mean of texture ``t``, 0 to 1, over the parallelogram of sides (au, av), (bu, bv) around (u, v), in repetitions."""
    width, height = float(1 << index[t, 1]), float(1 << index[t, 2])
    a = np.sqrt((au * width) ** 2 + (av * height) ** 2)
    b = np.sqrt((bu * width) ** 2 + (bv * height) ** 2)
    if b > a:
        a, au, av, bu, bv = b, bu, bv, au, av
    across = abs(au * bv - av * bu) * width * height / max(a, 1e-9)
    across = max(across, a / MAX_SAMPLES)
    count = min(int(np.ceil(a / max(across, 1.0))), MAX_SAMPLES)
    level = np.log2(across) if across > 1.0 else 0.0
    if count <= 1:
        return float(_trilinear(texels, index, t, u, v, level))
    total = 0.0
    for k in range(count):
        s = (k + 0.5) / count - 0.5
        total += _trilinear(texels, index, t, u + s * au, v + s * av, level)
    return total / count


@njit(cache=True, nogil=True, error_model="numpy")
def surface_light(
    light: Float32Array, lookup: npt.NDArray[np.int64], w: int, u: float, v: float
) -> float:  # pragma: no cover - compiled
    """Baked irradiance at (u, v) of surface ``w``, bilinear between the nodes."""
    columns, rows = lookup[w, 3], lookup[w, 4]
    x, y = u * (columns - 1), v * (rows - 1)
    x0, y0 = min(int(x), columns - 2), min(int(y), rows - 2)
    ax, ay = x - x0, y - y0
    k = lookup[w, 2] + y0 * columns + x0
    upper = light[k] * (1.0 - ax) + light[k + 1] * ax
    lower = light[k + columns] * (1.0 - ax) + light[k + columns + 1] * ax
    return float(upper * (1.0 - ay) + lower * ay)


@njit(cache=True, nogil=True, error_model="numpy")
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
        level = np.log2(size) if size > 1.0 else 0.0
        layer = _trilinear(texels, index, overlay, look[w, OVERLAY_U] + su * u, look[w, OVERLAY_V] + sv * v, level)
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


@njit(cache=True, nogil=True, error_model="numpy")
def _radiance(
    x: float,
    y: float,
    z: float,
    share: float,
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
    """Radiance along the ray (x, y, 1) that meets surface ``w`` at ``z``; the footprint is ``share`` of pixel (i, j)."""
    p = planes
    xu, yu, xv, yv = rays[i, j, 2], rays[i, j, 3], rays[i, j, 4], rays[i, j, 5]
    # u = z (e . r) - shift and z = 1 / (n . r), so du = z e . dr - z^2 (n . dr) (e . r).
    e1, e2 = p[q, 3] * x + p[q, 4] * y + p[q, 5], p[q, 6] * x + p[q, 7] * y + p[q, 8]
    u, v, zs = z * e1 - shifts[q, 0], z * e2 - shifts[q, 1], z * share
    na, nb = z * zs * (p[q, 0] * xu + p[q, 1] * yu), z * zs * (p[q, 0] * xv + p[q, 1] * yv)
    au, av = zs * (p[q, 3] * xu + p[q, 4] * yu) - na * e1, zs * (p[q, 6] * xu + p[q, 7] * yu) - na * e2
    bu, bv = zs * (p[q, 3] * xv + p[q, 4] * yv) - nb * e1, zs * (p[q, 6] * xv + p[q, 7] * yv) - nb * e2
    value = reflectance(look, lookup, texels, index, w, u, v, au, av, bu, bv)
    value *= surface_light(light, lookup, w, u, v) + look[w, EMISSION]
    gloss = look[w, GLOSS]
    if gloss > 0.0:
        value += gloss * _highlight(lamps, lookup[w, 5], p, q, x, y, z)
    return float(value)


@njit(cache=True, nogil=True, error_model="numpy")
def is_edge(surface: npt.NDArray[np.int32], i: int, j: int) -> bool:  # pragma: no cover - compiled
    """Whether one of the four neighbours of a pixel sees another surface."""
    q = surface[i, j]
    height, width = surface.shape
    return bool(
        (i > 0 and surface[i - 1, j] != q)
        or (j > 0 and surface[i, j - 1] != q)
        or (i + 1 < height and surface[i + 1, j] != q)
        or (j + 1 < width and surface[i, j + 1] != q)
    )


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
    # Arrays are taken out of the tuples once: passing the tuples on per pixel costs more than the shading.
    surface, depth, candidates, counts = hits.surface, hits.depth, hits.candidates, hits.counts
    rays, planes, shifts, near, ids = all_rays.rays, view.planes, view.shifts, view.near, view.ids
    look, lookup, light = world.look, world.lookup, world.light
    texels, index = world.textures.texels, world.textures.index
    height, width = image.shape
    columns = all_rays.bounds.shape[1]
    for i in range(first * TILE, min(last * TILE, height)):
        for j in range(width):
            q, n, tile, total = surface[i, j], 1, (i // TILE) * columns + j // TILE, 0.0
            if is_edge(surface, i, j):
                n = EDGE_RAYS
            for k in range(n * n):
                s, t = (k // n + 0.5) / n - 0.5, (k % n + 0.5) / n - 0.5
                x = rays[i, j, 0] + s * rays[i, j, 2] + t * rays[i, j, 4]
                y = rays[i, j, 1] + s * rays[i, j, 3] + t * rays[i, j, 5]
                z = float(depth[i, j])
                if n > 1:
                    q, z, _, _ = nearest(x, y, candidates, counts[tile], tile, planes, shifts, near)
                if q >= 0:
                    total += _radiance(
                        x, y, z, 1.0 / n, q, ids[q], i, j, rays, planes, shifts,
                        look, lookup, light, texels, index, lamps,
                    )  # fmt: skip
            image[i, j] = total / (n * n)
