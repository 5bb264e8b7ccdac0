"""From the distorted pixel grid of a lens to the pinhole grid of the same camera without distortion.

Depth is interpolated as inverse depth, which is linear over the image of a plane, and only within one surface: the four
pixels around an ideal position must agree, one of them may be missing (the plane through the others replaces it), otherwise
the output has no depth there. Foreground and background are never mixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from slam_core.camera import Camera
from slam_core.types import Float32Array


@dataclass(frozen=True, eq=False)
class RectificationMap:
    """Where each pixel of the ideal image lies in the distorted one: ``u``, ``v`` float32 (height, width) px."""

    camera: Camera
    u: Float32Array
    v: Float32Array

    @classmethod
    def of(cls, camera: Camera) -> RectificationMap:
        """Map from ``camera`` to the pinhole camera with the same camera matrix and size."""
        ideal = replace(camera, distortion_model="none", distortion=())
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = ideal.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        pixels = camera.pixels_from_normalised(rays).astype(np.float32).reshape(camera.height, camera.width, 2)
        return cls(ideal, np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1]))

    def image(self, image: Float32Array) -> Float32Array:
        """Bilinear resampling of a picture (amplitude, intensity); zero outside the distorted image."""
        return np.asarray(cv2.remap(image, self.u, self.v, cv2.INTER_LINEAR), dtype=np.float32)

    def depth(
        self, depth: Float32Array, sigma: Float32Array, slope: float, noise_multiple: float
    ) -> tuple[Float32Array, Float32Array]:
        """Edge-safe resampling of a depth image and its standard deviation (m, NaN where there is none).

        Parameters
        ----------
        slope
            Change of depth per pixel, relative to depth, of the steepest believable surface.
        noise_multiple
            Difference of neighbours explained by noise, in standard deviations.
        """
        result: tuple[Float32Array, Float32Array] = _resample(
            depth, sigma, self.u, self.v, np.float32(slope), np.float32(noise_multiple)
        )
        return result


@njit(cache=True, nogil=True)
def _resample(depth, sigma, map_u, map_v, slope, noise_multiple):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    out = np.full(map_u.shape, np.nan, dtype=np.float32)
    out_sigma = np.full(map_u.shape, np.nan, dtype=np.float32)
    for i in range(map_u.shape[0]):
        for j in range(map_u.shape[1]):
            u, v = map_u[i, j], map_v[i, j]
            if not (-0.001 <= u <= width - 0.999 and -0.001 <= v <= height - 0.999):
                continue
            u0, v0 = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
            window = depth[v0 : v0 + 2, u0 : u0 + 2]
            window_sigma = sigma[v0 : v0 + 2, u0 : u0 + 2]
            out[i, j], out_sigma[i, j] = _interpolate(window, window_sigma, u - u0, v - v0, slope, noise_multiple)
    return out, out_sigma


@njit(cache=True, nogil=True)
def _interpolate(z, s, a, b, slope, noise_multiple):  # type: ignore[no-untyped-def]
    """Depth and sigma at (a, b) inside a 2x2 window of one surface; NaN if it is not one."""
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    missing = 0
    low, high, noise = np.inf, 0.0, 0.0
    for k in range(4):
        value = z[k // 2, k % 2]
        if np.isfinite(value):
            low, high, noise = min(low, value), max(high, value), max(noise, s[k // 2, k % 2])
        else:
            missing += 1
    if missing > 1 or high - low > 2.0 * slope * low + 1.5 * noise_multiple * noise:
        return np.nan, np.nan
    # A missing corner is the plane through the other three: its weight goes +, +, - to them.
    if not np.isfinite(z[0, 0]):
        w01, w10, w11, w00 = w01 + w00, w10 + w00, w11 - w00, 0.0
    elif not np.isfinite(z[0, 1]):
        w00, w11, w10, w01 = w00 + w01, w11 + w01, w10 - w01, 0.0
    elif not np.isfinite(z[1, 0]):
        w00, w11, w01, w10 = w00 + w10, w11 + w10, w01 - w10, 0.0
    elif not np.isfinite(z[1, 1]):
        w01, w10, w00, w11 = w01 + w11, w10 + w11, w00 - w11, 0.0
    inverse, variance = 0.0, 0.0
    for k, w in enumerate((w00, w01, w10, w11)):
        if w != 0.0:
            value = z[k // 2, k % 2]
            inverse += w / value
            variance += (w * s[k // 2, k % 2] / (value * value)) ** 2
    return 1.0 / inverse, np.sqrt(variance) / (inverse * inverse)
