# SPDX-License-Identifier: Apache-2.0
"""The stereo camera: Bumblebee2 geometry, and what lens, exposure and sensor do to the light.

Both raw cameras are turned a little out of the rectified frame and have barrel distortion, so that rectification
matters. The rectified left frame is the rig's origin: ``T_rig_left`` is the fixed axes change, the right camera
stands ``baseline`` to the right of it.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numba import njit

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.config import Config, parameter
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, make_transform, so3_exp
from slam_core.types import ByteArray, Float32Array
from slam_simulation.rendering.raycaster import TILE, Rays, camera_rays, for_tile_rows, make_view, trace
from slam_simulation.rendering.shading import render
from slam_simulation.rendering.shutter import rolled, stepped
from slam_simulation.rendering.smoke import seen_through
from slam_simulation.sensors.calibrated_pair import calibrated_pair
from slam_simulation.sensors.profiles import RealismConfig
from slam_simulation.world.surface_table import SurfaceTable

SIDES = ("left", "right")
Motion: TypeAlias = tuple[FloatArray, FloatArray]
"""Pose ``T_world_rig`` (4, 4) and velocity (6,) of a rig, m/s and rad/s, rig axes."""


@dataclass(frozen=True)
class StereoSensorConfig(Config):
    """A Bumblebee2 in indoor light."""

    width: int = parameter(640, "image width", unit="px", minimum=32)
    height: int = parameter(480, "image height", unit="px", minimum=32)
    focal_length: float = parameter(
        283.0, "focal length of the rectified images: 97 degrees across", unit="px", minimum=1.0
    )
    baseline: float = parameter(0.12, "distance of the two cameras", unit="m", minimum=0.001)
    raw_focal_length: float = parameter(332.0, "focal length of the raw images", unit="px", minimum=1.0)
    distortion: tuple[float, ...] = parameter(
        (-0.28, 0.07, 0.0004, -0.0003, 0.0), "plumb_bob k1 k2 p1 p2 k3 of the left lens"
    )
    distortion_spread: float = parameter(0.02, "relative difference of the right lens", minimum=0.0)
    left_tilt_deg: tuple[float, ...] = parameter(
        (0.15, -0.2, 0.1), "rotation vector of the left raw camera", unit="deg"
    )
    right_tilt_deg: tuple[float, ...] = parameter(
        (-0.25, 0.35, -0.3), "rotation vector of the right raw camera", unit="deg"
    )
    exposure_ms: float = parameter(6.0, "exposure time, blurs motion", unit="ms", minimum=0.0)
    brightness: float = parameter(0.42, "mean image brightness the exposure control aims at", minimum=0.01, maximum=1.0)
    exposure_lag: float = parameter(
        0.7, "share of the old gain that the exposure control keeps per frame", minimum=0.0, maximum=0.99
    )
    gain_mismatch: float = parameter(
        0.03, "relative brightness difference of the right camera", minimum=0.0, maximum=0.5
    )
    gain_jitter: float = parameter(0.01, "random brightness change per frame (mains flicker)", minimum=0.0, maximum=0.5)
    blur_px: float = parameter(0.7, "lens blur, standard deviation", unit="px", minimum=0.0)
    read_noise: float = parameter(1.5, "noise of a dark pixel, of 255", minimum=0.0)
    electrons_per_level: float = parameter(20.0, "electrons per grey level: sets the shot noise", minimum=0.1)
    calibration_pictures: int = parameter(0, "pictures of a board that the calibration is made from; 0: it is exact")
    calibration_corner_px: float = parameter(0.15, "noise of a corner in these pictures", unit="px", minimum=0.0)
    vignetting: float = parameter(0.8, "strength of the cos^4 darkening towards the corners", minimum=0.0, maximum=1.0)
    drop_probability: float = parameter(0.0, "share of frames lost", minimum=0.0, maximum=0.9)
    stamp_jitter_us: float = parameter(
        0.0, "standard deviation of the right image's stamp about the left's", unit="us", minimum=0.0
    )
    right_late_ms: float = parameter(
        0.0, "by how much the right image is taken after the left one, of which its stamp says nothing", unit="ms"
    )


class StereoSensor:
    """Renders raw pairs. Keeps the state of the exposure control, so frames must be taken in order."""

    def __init__(
        self,
        config: StereoSensorConfig,
        seed: int = 0,
        *,
        rectified: bool = False,
        realism: RealismConfig | None = None,
    ) -> None:
        self.config = c = config
        self._realism = realism or RealismConfig()
        rng = np.random.default_rng([seed, 78])
        self.infos = tuple(camera_info(c, side, rectified=rectified) for side in SIDES)
        self.stereo = StereoCamera(self.infos[0].rectified, c.baseline)
        pair = calibrated_pair(self.infos, c.baseline, c.calibration_pictures, c.calibration_corner_px, rng)
        self.calibration_error = pair.error
        self.rays = tuple(camera_rays(camera) for camera in pair.cameras)
        T_rig_left = make_transform(OPTICAL_FROM_RIG.T, np.zeros(3))
        self.T_rig_raw = tuple(np.asarray(T_rig_left @ T) for T in pair.T_rectified_raw)
        self._shading = tuple(vignette(rays, c.vignetting) for rays in self.rays)
        self._gain = 0.0

    def capture(
        self,
        world: SurfaceTable,
        motion: tuple[Motion, Motion],
        rng: np.random.Generator,
        pool: ThreadPoolExecutor | None,
    ) -> tuple[ByteArray, ByteArray]:
        """One raw pair of a rig that moves so in the middle of the exposure of the left and of the right image."""
        light = [self._light(k, world, *motion[k], pool) for k in range(2)]
        wanted = self.config.brightness / max(float(light[0].mean()), 1e-6)
        lag = self.config.exposure_lag if self._gain > 0.0 else 0.0
        self._gain = lag * self._gain + (1.0 - lag) * wanted
        flicker = 1.0 + self.config.gain_jitter * rng.standard_normal()
        gain = stepped(self._gain, self._realism.exposure_step_ev) * flicker
        gains = (gain, gain * (1.0 + self.config.gain_mismatch))
        left, right = (expose(image, gain, self.config, rng) for image, gain in zip(light, gains, strict=True))
        return left, right

    def _light(
        self, k: int, world: SurfaceTable, T_world_rig: FloatArray, twist: FloatArray, pool: ThreadPoolExecutor | None
    ) -> Float32Array:
        """Light on the sensor of camera ``k``: radiance, smeared by motion, darkened and blurred by the lens."""
        rays, T_world_camera = self.rays[k], T_world_rig @ self.T_rig_raw[k]
        view = make_view(world, T_world_camera, rays.bounds)
        hits = trace(view, rays, pool)
        image = render(world, view, rays, hits, T_world_camera, pool)
        image = seen_through(image, hits.depth, self._realism.smoke)
        velocity = camera_twist(twist, self.T_rig_raw[k])
        image = rolled(image, hits.depth, rays, velocity, self._realism.readout_ms * 1e-3)
        if self.config.exposure_ms > 0.0:
            shift = velocity * (self.config.exposure_ms * 1e-3)
            image = motion_blur(image, hits.depth, rays, shift, pool)
        image *= self._shading[k]
        if self.config.blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.config.blur_px), dtype=np.float32)
        return image


def camera_info(config: StereoSensorConfig, side: str, *, rectified: bool = False) -> CameraInfo:
    """Calibration of one raw camera and its rectification, or of the ideal camera of the rectified images."""
    c, right = config, side == "right"
    cx, cy = (c.width - 1) / 2, (c.height - 1) / 2
    P = np.array([[c.focal_length, 0, cx, 0], [0, c.focal_length, cy, 0], [0, 0, 1.0, 0]])
    P[0, 3] = -c.focal_length * c.baseline if right else 0.0
    if rectified:
        return CameraInfo(Camera(c.width, c.height, c.focal_length, c.focal_length, cx, cy), np.eye(3), P)
    # Two lenses are never alike.
    focal, offset = (1.002 * c.raw_focal_length, (3.1, -2.4)) if right else (c.raw_focal_length, (-1.7, 1.2))
    distortion = tuple((1.0 + c.distortion_spread * right) * d for d in c.distortion)
    camera = Camera(c.width, c.height, focal, focal, cx + offset[0], cy + offset[1], "plumb_bob", distortion)
    return CameraInfo(camera, so3_exp(np.radians(c.right_tilt_deg if right else c.left_tilt_deg)), P)


def camera_twist(twist: FloatArray, T_rig_camera: FloatArray) -> FloatArray:
    """Velocity (6,) of a camera in its own frame, from the rig's ``twist`` in the rig's frame."""
    R, t = T_rig_camera[:3, :3], T_rig_camera[:3, 3]
    return np.concatenate([R.T @ (twist[:3] + np.cross(twist[3:], t)), R.T @ twist[3:]])


def vignette(rays: Rays, strength: float) -> Float32Array:
    """Darkening by the cosine law (cos^4 of the angle to the axis), float32 (h, w); ``strength`` 1 is the full law."""
    cos_sq = 1.0 / (1.0 + rays.rays[..., 0] ** 2 + rays.rays[..., 1] ** 2)
    return np.asarray(1.0 - strength * (1.0 - cos_sq**2), dtype=np.float32)


def expose(light: Float32Array, gain: float, config: StereoSensorConfig, rng: np.random.Generator) -> ByteArray:
    """Grey levels with shot and read noise, clipped and rounded."""
    level = light * np.float32(255.0 * gain)
    sigma = np.sqrt(level / np.float32(config.electrons_per_level) + np.float32(config.read_noise**2))
    level += sigma * rng.standard_normal(level.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(level), 0, 255), dtype=np.uint8)


def motion_blur(
    image: Float32Array, depth: Float32Array, rays: Rays, shift: FloatArray, pool: ThreadPoolExecutor | None = None
) -> Float32Array:
    """Smear every pixel along the path its surface takes while the camera moves by ``shift`` (6,), m and rad."""
    out = np.empty_like(image)
    bands = rays.bounds.shape[0]
    for_tile_rows(bands, pool, lambda first, last: _smear_rows(first, last, image, depth, rays.rays, shift, out))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _smear_rows(
    first: int,
    last: int,
    image: Float32Array,
    depth: Float32Array,
    rays: Float32Array,
    shift: FloatArray,
    out: Float32Array,
) -> None:  # pragma: no cover - compiled
    height, width = image.shape
    for i in range(first * TILE, min(last * TILE, height)):
        for j in range(width):
            x, y = rays[i, j, 0], rays[i, j, 1]
            xu, yu, xv, yv = rays[i, j, 2], rays[i, j, 3], rays[i, j, 4], rays[i, j, 5]
            inverse = 1.0 / depth[i, j] if depth[i, j] > 0.0 else 0.0
            # Motion of the point in the camera's frame, over its depth: -(v / z + w x (x, y, 1)).
            px = -shift[0] * inverse - (shift[4] - shift[5] * y)
            py = -shift[1] * inverse - (shift[5] * x - shift[3])
            pz = -shift[2] * inverse - (shift[3] * y - shift[4] * x)
            dx, dy = px - x * pz, py - y * pz
            determinant = xu * yv - xv * yu
            du = (yv * dx - xv * dy) / determinant
            dv = (xu * dy - yu * dx) / determinant
            steps = min(int(max(abs(du), abs(dv)) + 0.7), 24)
            if steps < 1:
                out[i, j] = image[i, j]
                continue
            total = 0.0
            for k in range(-steps, steps + 1):
                t = 0.5 * k / (steps + 0.5)
                u = min(max(j + t * du, 0.0), width - 1.001)
                v = min(max(i + t * dv, 0.0), height - 1.001)
                u0, v0 = int(u), int(v)
                a, b = u - u0, v - v0
                upper = image[v0, u0] * (1.0 - a) + image[v0, u0 + 1] * a
                lower = image[v0 + 1, u0] * (1.0 - a) + image[v0 + 1, u0 + 1] * a
                total += upper * (1.0 - b) + lower * b
            out[i, j] = total / (2 * steps + 1)
