# SPDX-License-Identifier: Apache-2.0
"""From the distorted pixel grid of a lens to the pinhole grid of the same camera without distortion.

Depth is interpolated as inverse depth, which is linear over the image of a plane, and only within one surface: the
four pixels around an ideal position must agree, one of them may be missing (the plane through the others replaces it),
otherwise the output has no depth there. Foreground and background are never mixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from slam_core.camera import Camera
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, Float32Array


@dataclass(frozen=True, eq=False)
class RectificationMap:
    """Position of each pixel of the ideal image in the distorted one: ``u``, ``v`` float32 (height, width) px."""

    u: Float32Array
    v: Float32Array

    @classmethod
    def between(cls, camera: Camera, ideal: Camera) -> RectificationMap:
        """Map from the images of ``camera`` to those of ``ideal``, a camera without distortion at the same place."""
        v, u = np.mgrid[: ideal.height, : ideal.width]
        rays = ideal.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        pixels = camera.pixels_from_normalised(rays).astype(np.float32).reshape(ideal.height, ideal.width, 2)
        return cls(np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1]))

    def image(self, image: Float32Array) -> Float32Array:
        """Bilinear resampling of a picture (amplitude, intensity); zero outside the distorted image."""
        return np.asarray(cv2.remap(image, self.u, self.v, cv2.INTER_LINEAR), dtype=np.float32)

    def colour(self, image: ByteArray) -> ByteArray:
        """Resampled colour picture (height, width, 3) uint8."""
        return np.asarray(cv2.remap(image, self.u, self.v, cv2.INTER_LINEAR), dtype=np.uint8)

    def depth(
        self, depth: Float32Array, sigma: Float32Array, slope: float, noise_multiple: float
    ) -> tuple[Float32Array, Float32Array]:
        """Edge-safe resampling of a depth image and its standard deviation (m, NaN where there is none).

        Parameters
        ----------
        depth, sigma
            Distorted images, shape (height, width), m, NaN where there is no depth.
        slope
            Change of depth per pixel, relative to depth, of the steepest believable surface.
        noise_multiple
            Difference of neighbours explained by noise, in standard deviations.
        """
        with np.errstate(divide="ignore"):
            inverse = np.float32(1.0) / depth
        inverse_sigma = sigma * np.square(inverse)
        out, out_sigma = _resample(
            inverse, inverse_sigma, self.u, self.v, np.float32(2.0 * slope), np.float32(1.5 * noise_multiple)
        )
        return 1.0 / out, out_sigma / np.square(out)


@njit(cache=True, nogil=True)
def _resample(q, s, map_u, map_v, slope, noise_multiple):  # type: ignore[no-untyped-def]
    """Interpolated ``q`` with standard deviation ``s`` where the four corners are one surface, else NaN."""
    height, width = q.shape
    out = np.full(map_u.shape, np.nan, dtype=np.float32)
    out_sigma = np.full(map_u.shape, np.nan, dtype=np.float32)
    margin, one = np.float32(0.001), np.float32(1.0)
    for i in range(map_u.shape[0]):
        for j in range(map_u.shape[1]):
            u, v = map_u[i, j], map_v[i, j]
            if not (-margin <= u <= width - 1 + margin and -margin <= v <= height - 1 + margin):
                continue
            m, n = min(max(int(v), 0), height - 2), min(max(int(u), 0), width - 2)
            a, b = u - np.float32(n), v - np.float32(m)
            q4 = (q[m, n], q[m, n + 1], q[m + 1, n], q[m + 1, n + 1])
            s4 = (s[m, n], s[m, n + 1], s[m + 1, n], s[m + 1, n + 1])
            w4 = ((one - a) * (one - b), a * (one - b), (one - a) * b, a * b)
            if np.isnan(q4[0] + q4[1] + q4[2] + q4[3]):
                q4, s4, w4 = _without_missing_corner(q4, s4, w4)
            low, high = min(q4), max(q4)
            if high - low <= slope * low + noise_multiple * max(s4):
                out[i, j] = w4[0] * q4[0] + w4[1] * q4[1] + w4[2] * q4[2] + w4[3] * q4[3]
                variance = (w4[0] * s4[0]) ** 2 + (w4[1] * s4[1]) ** 2 + (w4[2] * s4[2]) ** 2 + (w4[3] * s4[3]) ** 2
                out_sigma[i, j] = np.sqrt(variance)
    return out, out_sigma


@in_place()
def _without_missing_corner(q, s, w):  # type: ignore[no-untyped-def]
    """Corners and weights with a missing corner as the plane through the others; all NaN if two are missing."""
    zero = np.float32(0.0)
    if np.isnan(q[0]):
        q, s, w = (q[1], q[1], q[2], q[3]), (zero, s[1], s[2], s[3]), (zero, w[1] + w[0], w[2] + w[0], w[3] - w[0])
    elif np.isnan(q[1]):
        q, s, w = (q[0], q[0], q[2], q[3]), (s[0], zero, s[2], s[3]), (w[0] + w[1], zero, w[2] - w[1], w[3] + w[1])
    elif np.isnan(q[2]):
        q, s, w = (q[0], q[1], q[0], q[3]), (s[0], s[1], zero, s[3]), (w[0] + w[2], w[1] - w[2], zero, w[3] + w[2])
    else:
        q, s, w = (q[0], q[1], q[2], q[1]), (s[0], s[1], s[2], zero), (w[0] - w[3], w[1] + w[3], w[2] + w[3], zero)
    nan = np.float32(np.nan)
    return ((nan, nan, nan, nan) if np.isnan(q[0] + q[1] + q[2] + q[3]) else q), s, w
