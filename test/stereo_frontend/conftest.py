# SPDX-License-Identifier: Apache-2.0
"""Synthetic images with exact sub-pixel geometry: a sum of random waves can be evaluated anywhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from slam_core.camera import Camera, StereoCamera
from slam_core.types import StereoImages

WIDTH, HEIGHT = 320, 240


class Texture:
    """Grey value at any point (x, y) px: random waves of 5 to 60 px."""

    def __init__(self, seed: int, waves: int = 60) -> None:
        rng = np.random.default_rng(seed)
        angle, self._phase = rng.uniform(0, 2 * np.pi, (2, waves))
        wavelength = np.exp(rng.uniform(np.log(5.0), np.log(60.0), waves))
        self._k = 2 * np.pi / wavelength * np.array([np.cos(angle), np.sin(angle)])
        self._amplitude = wavelength**0.5 / np.sqrt(np.sum(wavelength) / 2)

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        value = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase, amplitude in zip(*self._k, self._phase, self._amplitude, strict=True):
            value += amplitude * np.cos(kx * x + ky * y + phase)
        return 128 + 40 * value


def as_picture(values: np.ndarray, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    noisy = values + np.random.default_rng(seed).normal(0.0, noise, values.shape) if noise else values
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def stereo_pair() -> Callable[..., StereoImages]:
    """Makes a rectified pair of a plane: disparity = d0 + a u_left (px)."""

    def make(
        disparity: float = 12.3,
        slope: float = 0.0,
        noise: float = 2.0,
        seed: int = 1,
        gain: float = 1.0,
        row: float = 0.0,
    ) -> StereoImages:
        texture = Texture(seed)
        u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
        left = texture(u, v)
        right = texture((u + disparity) / (1.0 - slope), v - row)
        camera = Camera(WIDTH, HEIGHT, 200.0, 200.0, WIDTH / 2, HEIGHT / 2)
        pictures = as_picture(left, noise, seed), as_picture(gain * right, noise, seed + 1)
        return StereoImages(1_000_000_000, *pictures, StereoCamera(camera, 0.12))

    return make
