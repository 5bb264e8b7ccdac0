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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _trilinear(
    texels: ByteArray, entry: npt.NDArray[np.int64], u: float, v: float, level: float
) -> float:  # pragma: no cover - compiled
    """Texture value 0 to 1 at (u, v) of a level between two of the mip chain."""
    offset, width, height, clamp = entry[0], 1 << entry[1], 1 << entry[2], entry[3]
    top = max(entry[1], entry[2])
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
    return value * (1.0 / 255.0)


@njit(cache=True, nogil=True)
def sample_texture(
    texels: ByteArray,
    entry: npt.NDArray[np.int64],
    u: float,
    v: float,
    au: float,
    av: float,
    bu: float,
    bv: float,
) -> float:  # pragma: no cover - compiled
    """Mean texture value 0 to 1 over the parallelogram of sides (au, av), (bu, bv) around (u, v), in repetitions."""
    width, height = float(1 << entry[1]), float(1 << entry[2])
    a = np.sqrt((au * width) ** 2 + (av * height) ** 2)
    b = np.sqrt((bu * width) ** 2 + (bv * height) ** 2)
    if b > a:
        a, au, av, bu, bv = b, bu, bv, au, av
    across = abs(au * bv - av * bu) * width * height / max(a, 1e-9)
    across = max(across, a / MAX_SAMPLES)
    count = min(int(np.ceil(a / max(across, 1.0))), MAX_SAMPLES)
    level = np.log2(across) if across > 1.0 else 0.0
    if count <= 1:
        return _trilinear(texels, entry, u, v, level)
    total = 0.0
    for k in range(count):
        t = (k + 0.5) / count - 0.5
        total += _trilinear(texels, entry, u + t * au, v + t * av, level)
    return total / count


@njit(cache=True, nogil=True)
def surface_light(world: SurfaceTable, w: int, u: float, v: float) -> float:  # pragma: no cover - compiled
    """Baked irradiance at (u, v) of surface ``w``, bilinear between the nodes."""
    offset, columns, rows = world.lookup[w, 2], world.lookup[w, 3], world.lookup[w, 4]
    x, y = u * (columns - 1), v * (rows - 1)
    x0, y0 = min(int(x), columns - 2), min(int(y), rows - 2)
    ax, ay = x - x0, y - y0
    k = offset + y0 * columns + x0
    upper = world.light[k] * (1.0 - ax) + world.light[k + 1] * ax
    lower = world.light[k + columns] * (1.0 - ax) + world.light[k + columns + 1] * ax
    return upper * (1.0 - ay) + lower * ay


@njit(cache=True, nogil=True)
def reflectance(
    world: SurfaceTable, w: int, u: float, v: float, au: float, av: float, bu: float, bv: float
) -> float:  # pragma: no cover - compiled
    """Diffuse reflectance of surface ``w`` over a footprint in its own (u, v)."""
    look, texels = world.look[w], world.textures.texels
    su, sv = look[SCALE_U], look[SCALE_V]
    entry = world.textures.index[world.lookup[w, 0]]
    value = sample_texture(
        texels, entry, look[SHIFT_U] + su * u, look[SHIFT_V] + sv * v, su * au, sv * av, su * bu, sv * bv
    )
    if world.lookup[w, 1] >= 0:
        entry = world.textures.index[world.lookup[w, 1]]
        su, sv = look[OVERLAY_SCALE_U], look[OVERLAY_SCALE_V]
        size = np.sqrt(abs(au * bv - av * bu) * su * sv) * (1 << entry[1])
        level = np.log2(size) if size > 1.0 else 0.0
        layer = _trilinear(texels, entry, look[OVERLAY_U] + su * u, look[OVERLAY_V] + sv * v, level)
        value *= 1.0 + look[OVERLAY_GAIN] * (layer - 0.5)
    return value * look[BRIGHTNESS]


@njit(cache=True, nogil=True)
def _highlight(
    world: SurfaceTable, w: int, plane: FloatArray, x: float, y: float, z: float, lamps: FloatArray
) -> float:  # pragma: no cover - compiled
    """Mirror-like reflection of the room's lamps (Blinn 1977), which moves with the camera."""
    scale = -1.0 / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
    view = 1.0 / np.sqrt(x * x + y * y + 1.0)
    total = 0.0
    for k in range(lamps.shape[0]):
        if lamps[k, 4] != world.lookup[w, 5]:
            continue
        lx, ly, lz = lamps[k, 0] - x * z, lamps[k, 1] - y * z, lamps[k, 2] - z
        distance_sq = lx * lx + ly * ly + lz * lz
        inverse = 1.0 / np.sqrt(distance_sq)
        hx, hy, hz = lx * inverse - x * view, ly * inverse - y * view, lz * inverse - view
        length = np.sqrt(hx * hx + hy * hy + hz * hz)
        cosine = scale * (plane[0] * hx + plane[1] * hy + plane[2] * hz) / max(length, 1e-9)
        if cosine > 0.8:
            total += lamps[k, 3] / distance_sq * np.exp(SHININESS * np.log(cosine))
    return total * world.look[w, GLOSS]


@njit(cache=True, nogil=True)
def _radiance(
    world: SurfaceTable,
    view: View,
    q: int,
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    ray: Float32Array,
    share: float,
    lamps: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Radiance along one ray; the footprint is ``share`` of the pixel's."""
    w, p = view.ids[q], view.planes[q]
    # d(u)/d(pixel) on the plane: u = z (e . r) - shift and z = 1 / (n . r).
    e1, e2 = p[3] * x + p[4] * y + p[5], p[6] * x + p[7] * y + p[8]
    zz = z * z * share
    na, nb = p[0] * ray[2] + p[1] * ray[3], p[0] * ray[4] + p[1] * ray[5]
    zs = z * share
    au = zs * (p[3] * ray[2] + p[4] * ray[3]) - zz * na * e1
    av = zs * (p[6] * ray[2] + p[7] * ray[3]) - zz * na * e2
    bu = zs * (p[3] * ray[4] + p[4] * ray[5]) - zz * nb * e1
    bv = zs * (p[6] * ray[4] + p[7] * ray[5]) - zz * nb * e2
    value = reflectance(world, w, u, v, au, av, bu, bv)
    light = surface_light(world, w, u, v) + world.look[w, EMISSION]
    if world.look[w, GLOSS] > 0.0:
        return value * light + _highlight(world, w, p, x, y, z, lamps)
    return value * light


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _edge_pixel(
    world: SurfaceTable, view: View, ray: Float32Array, hits: Hits, tile: int, lamps: FloatArray
) -> float:  # pragma: no cover - compiled
    """Mean radiance over EDGE_RAYS x EDGE_RAYS rays of a pixel."""
    total = 0.0
    for a in range(EDGE_RAYS):
        for b in range(EDGE_RAYS):
            s, t = (a + 0.5) / EDGE_RAYS - 0.5, (b + 0.5) / EDGE_RAYS - 0.5
            x, y = ray[0] + s * ray[2] + t * ray[4], ray[1] + s * ray[3] + t * ray[5]
            q, z, u, v = nearest(x, y, hits.candidates[tile], hits.counts[tile], view.planes, view.shifts, view.near)
            if q >= 0:
                total += _radiance(world, view, q, x, y, z, u, v, ray, 1.0 / EDGE_RAYS, lamps)
    return total / EDGE_RAYS**2


@njit(cache=True, nogil=True)
def _render_rows(
    first: int,
    last: int,
    world: SurfaceTable,
    view: View,
    rays: Rays,
    hits: Hits,
    lamps: FloatArray,
    image: Float32Array,
) -> None:  # pragma: no cover - compiled
    height, width = image.shape
    columns = rays.bounds.shape[1]
    for i in range(first * TILE, min(last * TILE, height)):
        for j in range(width):
            ray = rays.rays[i, j]
            if is_edge(hits.surface, i, j):
                image[i, j] = _edge_pixel(world, view, ray, hits, (i // TILE) * columns + j // TILE, lamps)
                continue
            q = hits.surface[i, j]
            if q < 0:
                continue
            x, y, z = float(ray[0]), float(ray[1]), float(hits.depth[i, j])
            p = view.planes[q]
            u = z * (p[3] * x + p[4] * y + p[5]) - view.shifts[q, 0]
            v = z * (p[6] * x + p[7] * y + p[8]) - view.shifts[q, 1]
            image[i, j] = _radiance(world, view, q, x, y, z, u, v, ray, 1.0, lamps)
