# SPDX-License-Identifier: Apache-2.0
"""The time-of-flight camera: CamCube geometry, and range by the phase of modulated light.

Each pixel measures a phasor ``A exp(j 4 pi f r / c)``: amplitude A from reflectance, angle and distance, phase from
range. Noise is white on the phasor, which gives everything else for free (Lange 2000): range noise ``sigma_r = L / (2
pi) sigma / A`` that falls with amplitude, wrapping at the ambiguity range L, random ranges in dark pixels, and flying
pixels, where a pixel at an edge adds the phasors of two surfaces.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform, so3_exp
from slam_core.types import ByteArray, Float32Array
from slam_simulation.rendering.pixel_surfaces import EDGE_RAYS, place_on_surface, surfaces_of_pixel
from slam_simulation.rendering.raycaster import TILE, Hits, Rays, View, camera_rays, for_tile_rows, make_view, trace
from slam_simulation.rendering.shading import reflectance, surface_light
from slam_simulation.rendering.smoke import echo_through
from slam_simulation.sensors.profiles import RealismConfig
from slam_simulation.sensors.tof_errors import wiggle, with_indirect_light
from slam_simulation.world.surface_table import Look, SurfaceTable

INFRARED = Look.INFRARED


@dataclass(frozen=True)
class TofSensorConfig(Config):
    """A PMD CamCube at 20 MHz."""

    size: int = parameter(204, "pixels along each side", unit="px", minimum=16)
    focal_length: float = parameter(280.0, "focal length: 40 degrees across", unit="px", minimum=1.0)
    distortion: tuple[float, ...] = parameter((-0.38, 0.2, 0.001, -0.0008, 0.0), "plumb_bob k1 k2 p1 p2 k3")
    position: tuple[float, ...] = parameter((0.0, 0.0, -0.09), "place in the rig: under the left camera", unit="m")
    tilt_deg: tuple[float, ...] = parameter((0.3, -0.4, 0.2), "rotation vector out of the rig's direction", unit="deg")
    ambiguity_range: float = parameter(7.5, "range at which the phase wraps", unit="m", minimum=0.1)
    reference_sigma: float = parameter(
        0.003, "range noise at 2 m, head-on, on the reference reflectance", unit="m", minimum=0.0
    )
    reference_reflectance: float = parameter(
        0.5, "infrared reflectance of the specification", minimum=0.01, maximum=1.0
    )
    amplitude_scale: float = parameter(1000.0, "amplitude of a white surface at 1 m, head-on", minimum=1.0)
    saturation: float = parameter(2200.0, "greatest sum of amplitude and ambient light a pixel takes", minimum=1.0)
    ambient_scale: float = parameter(120.0, "intensity of a white surface in the room's light", minimum=0.0)
    offset_noise: float = parameter(
        0.002, "spread of the constant range error from pixel to pixel", unit="m", minimum=0.0
    )
    illumination_falloff: float = parameter(0.5, "loss of light at the corners of the image", minimum=0.0, maximum=1.0)


@dataclass(frozen=True, eq=False)
class TofImages:
    """Raw images of one moment, float32 (size, size): range m along the ray (0: saturated), amplitude, intensity."""

    range: Float32Array
    amplitude: Float32Array
    intensity: Float32Array


class TofSensor:
    """Renders the ToF camera's three images."""

    def __init__(self, config: TofSensorConfig, seed: int, realism: RealismConfig | None = None) -> None:
        self.config = c = config
        self._realism = realism or RealismConfig()
        centre = (c.size - 1) / 2
        self.camera = Camera(
            c.size, c.size, c.focal_length, c.focal_length, centre + 0.8, centre - 1.3, "plumb_bob", c.distortion
        )
        R = OPTICAL_FROM_RIG.T @ so3_exp(np.radians(c.tilt_deg))
        self.T_rig_tof = make_transform(R, np.array(c.position))
        self.rays = camera_rays(self.camera)
        pattern = np.random.default_rng([seed, 77]).standard_normal((c.size, c.size))
        self._offset = (c.offset_noise * pattern).astype(np.float32)
        r_sq = (self.rays.rays[..., :2] ** 2).sum(axis=-1)
        self._illumination = 1.0 - c.illumination_falloff * r_sq / r_sq.max()

    def range_sigma(self, amplitude: FloatArray) -> FloatArray:
        """Standard deviation (m) of the range noise at an amplitude."""
        c = self.config
        reference = c.amplitude_scale * c.reference_reflectance / 4.0
        return np.asarray(c.reference_sigma * reference / np.maximum(amplitude, 1e-6))

    def capture(
        self, world: SurfaceTable, T_world_rig: FloatArray, rng: np.random.Generator, pool: ThreadPoolExecutor | None
    ) -> TofImages:
        """Range, amplitude and intensity at one moment."""
        phasor, ambient = self.ideal(world, T_world_rig, pool)
        c, shape = self.config, phasor.shape
        # One part of the phasor carries the noise that moves the phase.
        sigma = float(self.range_sigma(np.array(1.0))) * 2.0 * np.pi / c.ambiguity_range
        noisy = phasor + sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        amplitude = np.abs(noisy)
        distance = np.mod(np.angle(noisy) / (2.0 * np.pi), 1.0) * c.ambiguity_range + self._offset
        distance += wiggle(distance, c.ambiguity_range, self._realism.tof)
        distance = np.mod(distance, c.ambiguity_range)
        intensity = ambient + amplitude + np.sqrt(ambient + amplitude) * 0.5 * rng.standard_normal(shape)
        saturated = amplitude + ambient > c.saturation
        distance[saturated] = 0.0
        amplitude[saturated] = c.saturation
        images = (distance, amplitude, np.clip(intensity, 0.0, 2.0 * c.saturation))
        return TofImages(*(image.astype(np.float32) for image in images))

    def ideal(
        self, world: SurfaceTable, T_world_rig: FloatArray, pool: ThreadPoolExecutor | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Phasor (complex) and ambient light without noise; amplitude and unwrapped phase are the surfaces' own."""
        T = T_world_rig @ self.T_rig_tof
        view = make_view(world, T, self.rays.bounds)
        hits = trace(view, self.rays, pool)
        size = self.config.size
        out = np.zeros((size, size, 3))
        wave = 2.0 * np.pi / self.config.ambiguity_range
        for_tile_rows(
            self.rays.bounds.shape[0],
            pool,
            lambda first, last: _phasor_rows(first, last, world, view, self.rays, hits, wave, out),
        )
        scale = self._illumination * self.config.amplitude_scale
        direct = np.asarray(scale * (out[..., 0] + 1j * out[..., 1]))
        return self._disturbed(direct, hits), np.asarray(self.config.ambient_scale * out[..., 2])

    def _disturbed(self, phasor: FloatArray, hits: Hits) -> FloatArray:
        """Light of the surfaces on the sensor, smoke and indirect light included."""
        c, r = self.config, self._realism
        distance = hits.depth * np.sqrt(1.0 + (self.rays.rays[..., :2] ** 2).sum(axis=-1))
        phasor = echo_through(phasor, distance, c.ambiguity_range, c.amplitude_scale, r.smoke)
        return with_indirect_light(phasor, c.ambiguity_range, r.tof)


@njit(cache=True, nogil=True, error_model="numpy")
def _echo(
    x: float,
    y: float,
    q: int,
    w: int,
    pixel: float,
    planes: FloatArray,
    shifts: FloatArray,
    look: FloatArray,
    lookup: npt.NDArray[np.int64],
    texels: ByteArray,
    index: npt.NDArray[np.int64],
) -> tuple[float, float, float, float, float]:  # pragma: no cover - compiled
    """Distance, amplitude, infrared reflectance and place where a ray meets a row of the view.

    The ray is (x, y, 1), the row ``q``, the place (u, v).
    """
    p = planes
    z, u, v = place_on_surface(planes, shifts, q, x, y)
    ray_length = np.sqrt(x * x + y * y + 1.0)
    distance = z * ray_length
    # planes[:3] is normal / (normal . p), its product with the ray is 1/z.
    cosine = 1.0 / (distance * np.sqrt(p[q, 0] * p[q, 0] + p[q, 1] * p[q, 1] + p[q, 2] * p[q, 2]))
    width = pixel * z / max(cosine, 0.2)
    size_u = width * np.sqrt(p[q, 3] * p[q, 3] + p[q, 4] * p[q, 4] + p[q, 5] * p[q, 5])
    size_v = width * np.sqrt(p[q, 6] * p[q, 6] + p[q, 7] * p[q, 7] + p[q, 8] * p[q, 8])
    visible = reflectance(look, lookup, texels, index, w, u, v, size_u, 0.0, 0.0, size_v)
    infrared = min((0.12 + 0.85 * visible) * look[w, INFRARED], 1.0)
    return distance, infrared * cosine / (distance * distance), infrared, u, v


@njit(cache=True, nogil=True, error_model="numpy")
def _phasor_rows(
    first: int, last: int, world: SurfaceTable, view: View, all_rays: Rays, hits: Hits, wave: float, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` (h, w, 3): phasor (2) and ambient light of each pixel, summed over the surfaces that share it."""
    surface, candidates, counts = hits.surface, hits.candidates, hits.counts
    rays, planes, shifts, near, ids = all_rays.rays, view.planes, view.shifts, view.near, view.ids
    look, lookup, light = world.look, world.lookup, world.light
    texels, index = world.textures.texels, world.textures.entries
    height, width = surface.shape
    columns = all_rays.bounds.shape[1]
    parts = np.empty((EDGE_RAYS * EDGE_RAYS, 4))
    for i in range(first * TILE, min(last * TILE, height)):
        for j in range(width):
            tile = (i // TILE) * columns + j // TILE
            found = surfaces_of_pixel(i, j, tile, rays, surface, candidates, counts, planes, shifts, near, parts)
            for m in range(found):
                q, share = int(parts[m, 0]), parts[m, 1]
                distance, amplitude, infrared, u, v = _echo(
                    parts[m, 2], parts[m, 3], q, ids[q], rays[i, j, 2], planes, shifts, look, lookup, texels, index
                )
                out[i, j, 0] += share * amplitude * np.cos(wave * distance)
                out[i, j, 1] += share * amplitude * np.sin(wave * distance)
                out[i, j, 2] += share * infrared * surface_light(light, lookup, ids[q], u, v)
