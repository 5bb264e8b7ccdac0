# SPDX-License-Identifier: Apache-2.0
"""Rolling shutter and exposure in steps: what the readout of a camera adds to its light."""

from __future__ import annotations

import cv2
import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import Float32Array
from slam_simulation.rendering.raycaster import Rays


def rolled(
    image: Float32Array, depth: Float32Array, rays: Rays, velocity: FloatArray, readout_s: float
) -> Float32Array:
    """The image whose rows were taken one after the other within ``readout_s``, the middle one at the image's time.

    ``velocity`` (6,) m/s and rad/s of the camera in its own frame. Every row takes its pixels from where its surfaces
    were in the image at that moment.
    """
    if readout_s == 0.0:
        return image
    height, width = image.shape
    du, dv = pixel_velocity(depth, rays, velocity)
    late = (np.arange(height, dtype=np.float32)[:, None] / np.float32(height) - np.float32(0.5)) * np.float32(readout_s)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    moved = cv2.remap(image, u - late * du, v - late * dv, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.float32)


def pixel_velocity(depth: Float32Array, rays: Rays, velocity: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Velocity (h, w) px/s along u and v of the surfaces at ``depth`` m as the camera moves."""
    x, y, xu, yu, xv, yv = np.moveaxis(rays.rays, -1, 0)
    inverse = np.where(depth > 0.0, 1.0 / np.maximum(depth, 1e-3), 0.0)
    vx, vy, vz, wx, wy, wz = velocity
    px, py, pz = -vx * inverse - (wy - wz * y), -vy * inverse - (wz * x - wx), -vz * inverse - (wx * y - wy * x)
    dx, dy = px - x * pz, py - y * pz
    determinant = xu * yv - xv * yu
    along = (yv * dx - xv * dy) / determinant, (xu * dy - yu * dx) / determinant
    return along[0].astype(np.float32), along[1].astype(np.float32)


def stepped(gain: float, step_ev: float) -> float:
    """The gain that an exposure control with steps of ``step_ev`` stops sets instead of ``gain``."""
    return gain if step_ev == 0.0 else float(2.0 ** (step_ev * np.round(np.log2(gain) / step_ev)))
