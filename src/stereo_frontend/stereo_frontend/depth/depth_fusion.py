# SPDX-License-Identifier: Apache-2.0
"""Depth of stereo features from the ToF camera beside it: replaced or fused (thesis sections 11.2-11.4).

A left pixel is mapped into the ToF image through the extrinsics (11.3). The mapping needs the depth that is looked for:
the depth is iterated until the pixel stands still, which handles the parallax between the cameras. Fused depth is ``R =
(1/R1 + 1/R2)^-1``, ``d = R (d1/R1 + d2/R2)`` where stereo and ToF agree within their joint chi-square gate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.estimation.chi_square import chi_square_bound
from slam_core.geometry import FloatArray, invert_transform
from slam_core.runtime.in_place import in_place
from slam_core.types import DepthImage
from stereo_frontend.depth.depth_lookup import DepthSamples, fit_plane, sample_depth

_MOTION_SPEED = 0.3
"""Speed of the rig assumed when the stamps differ: depth sigma grows by speed times age, m/s."""
_MOTION_RATE = 0.3
"""Turn rate assumed when the stamps differ: pixel sigma grows by rate times age times f, rad/s."""
_MAPPING_SIGMA = 0.1
"""Standard deviation of the mapping into the ToF image, px."""

_GATE_PROBABILITY = 0.9973
"""Share of true pairs of stereo and ToF depth inside the gate: three sigma."""
_ITERATIONS = 8
_STANDS_STILL = 1e-6
"""A depth (m) that an iteration moves by less is at its place."""


@dataclass(frozen=True)
class FusionConfig(Config):
    """Fusion of ToF depth and stereo features."""

    max_age: float = parameter(0.06, "greatest time between the stereo pair and the depth image", unit="s", minimum=0.0)

    @property
    def gate(self) -> float:
        """Gate on the squared difference of both depths over its variance."""
        return chi_square_bound(_GATE_PROBABILITY, 1)


@dataclass(frozen=True, eq=False)
class MappedDepth:
    """Depth from the ToF camera for left pixels.

    depth, sigma: (n,) m along the left camera's z, NaN where the ToF camera sees no single surface. uv: (n, 2) px in
    the ToF image. ray_length: (n,) range over depth.
    """

    depth: FloatArray
    sigma: FloatArray
    uv: FloatArray
    ray_length: FloatArray


def map_depth(
    uv: npt.ArrayLike,
    initial_depth: FloatArray,
    camera: Camera,
    image: DepthImage,
    T_left_tof: FloatArray,
    age: float = 0.0,
) -> MappedDepth:
    """ToF depth of left pixels.

    Parameters
    ----------
    uv
        Pixels (n, 2) of the rectified left image.
    initial_depth
        First guess (n,) m, from stereo; NaN takes the median of the depth image.
    camera, image, T_left_tof
        Left camera, depth image and the pose (4, 4) of the ToF optical frame in the left one.
    age
        Difference of the stamps, s; its sign does not matter.
    """
    rays = camera.unproject(np.asarray(uv, np.float64), np.ones(len(initial_depth)))
    T_tof_left = invert_transform(T_left_tof)
    rays_tof, origin = rays @ T_tof_left[:3, :3].T, T_tof_left[:3, 3]
    depth = np.where(np.isfinite(initial_depth), initial_depth, _median_depth(image))
    c = image.camera
    _settle(image.depth, image.sigma, rays_tof, origin, (c.fx, c.fy, c.cx, c.cy), depth)
    pixels = image.camera.project(rays_tof * depth[:, None] + origin)
    samples = sample_depth(image, pixels)
    update = (samples.depth - origin[2]) / rays_tof[:, 2]
    settled = np.abs(update - depth) <= np.maximum(samples.sigma, 1e-3)
    depth = np.where(np.isfinite(update), update, depth)
    sigma = _mapped_sigma(samples, image.camera, age) / np.abs(rays_tof[:, 2])
    blank = np.where(settled & (depth > 0.0), 0.0, np.nan)
    return MappedDepth(update + blank, sigma + blank, pixels, np.linalg.norm(rays_tof, axis=1))


@in_place(error_model="numpy")
def _settle(image, sigma, rays, origin, intrinsics, depth):  # type: ignore[no-untyped-def]
    """Move ``depth`` (n,) m along rays (n, 3) in the frame of a depth image to where the image has the same depth."""
    fx, fy, cx, cy = intrinsics
    for i in range(len(depth)):
        for _ in range(_ITERATIONS - 1):
            d = depth[i]
            x, y, z = rays[i, 0] * d + origin[0], rays[i, 1] * d + origin[1], rays[i, 2] * d + origin[2]
            found = fit_plane(image, sigma, x / z * fx + cx, y / z * fy + cy)[0] if z > 0.0 else 0.0
            if found == 0.0:
                break
            update = (found - origin[2]) / rays[i, 2]
            moved = abs(update - d)
            depth[i] = update if np.isfinite(update) else d
            if not moved > _STANDS_STILL:
                break


def fuse_depth(
    stereo_depth: FloatArray, stereo_sigma: FloatArray, tof: MappedDepth, gate: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Fused depth, its standard deviation (n,) m and which features were fused; the others keep stereo's (11.4)."""
    R1, R2 = stereo_sigma**2, tof.sigma**2
    agrees = (stereo_depth - tof.depth) ** 2 <= gate * (R1 + R2)
    R = 1.0 / (1.0 / R1 + 1.0 / R2)
    depth = R * (stereo_depth / R1 + tof.depth / R2)
    return np.where(agrees, depth, stereo_depth), np.where(agrees, np.sqrt(R), stereo_sigma), agrees


def _mapped_sigma(samples: DepthSamples, camera: Camera, age: float) -> FloatArray:
    pixel = np.hypot(_MAPPING_SIGMA, _MOTION_RATE * age * camera.fx)
    across = np.linalg.norm(samples.gradient, axis=1) * pixel
    return np.asarray(np.sqrt(samples.sigma**2 + across**2 + (_MOTION_SPEED * age) ** 2))


def _median_depth(image: DepthImage) -> float:
    valid = image.depth[np.isfinite(image.depth) & (image.depth > 0.0)]
    return float(np.median(valid)) if len(valid) else 1.0
