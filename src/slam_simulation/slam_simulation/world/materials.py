# SPDX-License-Identifier: Apache-2.0
"""Patterns that repeat: plaster, brick, wood, tiles, carpet. Each is a tileable reflectance image made from a seed.

One pattern covers ``extent`` metres; walls lay a second, larger one over it so that no two places look alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.geometry import FloatArray

SIZE = 512
"""Side of a pattern, texels."""


@dataclass(frozen=True)
class Pattern:
    """Drawing of a pattern and its size: ``extent`` m of one repetition, both ways."""

    draw: Callable[[np.random.Generator], FloatArray]
    extent: float


def noise(rng: np.random.Generator, cells: tuple[int, int], octaves: int, persistence: float = 0.55) -> FloatArray:
    """Tileable multi-octave value noise (SIZE, SIZE), zero mean, unit spread.

    ``cells`` (x, y) in the coarsest octave.
    """
    total = np.zeros((SIZE, SIZE))
    for octave in range(octaves):
        nx, ny = min(cells[0] << octave, SIZE), min(cells[1] << octave, SIZE)
        total += persistence**octave * _wrapped_resize(rng.standard_normal((ny, nx)))
    return np.asarray((total - total.mean()) / total.std())


def _wrapped_resize(grid: FloatArray) -> FloatArray:
    margin = 2
    ny, nx = grid.shape
    sx, sy = SIZE // nx, SIZE // ny
    padded = np.pad(grid, margin, mode="wrap")
    size = ((nx + 2 * margin) * sx, (ny + 2 * margin) * sy)
    large = cv2.resize(padded, size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(large[margin * sy : margin * sy + SIZE, margin * sx : margin * sx + SIZE])


def _speckle(rng: np.random.Generator, image: FloatArray, count: int, radius: int, change: float) -> None:
    """Draw soft dots of random size and sign, wrapped at the borders."""
    layer = np.zeros((SIZE, SIZE), np.float32)
    for x, y, r, s in zip(
        rng.integers(0, SIZE, count),
        rng.integers(0, SIZE, count),
        rng.integers(1, radius + 1, count),
        rng.normal(0, change, count),
        strict=True,
    ):
        cv2.circle(layer, (int(x), int(y)), int(r), float(s), -1)
    image += cv2.blur(layer, (3, 3), borderType=cv2.BORDER_REFLECT)


def _plaster(rng: np.random.Generator) -> FloatArray:
    image = 0.80 + 0.012 * noise(rng, (64, 64), 3) + 0.012 * noise(rng, (4, 4), 3)
    _speckle(rng, image, 40, 3, 0.08)
    return image


def _blotches(rng: np.random.Generator) -> FloatArray:
    return 0.5 + 0.09 * noise(rng, (8, 8), 5)


def _concrete(rng: np.random.Generator) -> FloatArray:
    image = 0.45 + 0.035 * noise(rng, (16, 16), 5, 0.75)
    _speckle(rng, image, 250, 3, 0.08)
    return image


def _brick(rng: np.random.Generator) -> FloatArray:
    rows, columns = 16, 4
    image = np.full((SIZE, SIZE), 0.5)
    height, width = SIZE // rows, SIZE // columns
    for row in range(rows):
        for column in range(columns):
            x = column * width + (row % 2) * width // 2
            columns_px = np.arange(x + 3, x + width - 3) % SIZE
            image[row * height + 3 : (row + 1) * height - 3, columns_px] = rng.uniform(0.28, 0.42)
    return image + 0.03 * noise(rng, (16, 16), 5, 0.7)


def _wood(rng: np.random.Generator) -> FloatArray:
    grain = noise(rng, (2, 32), 5, 0.7)
    rings = np.sin(6.0 * noise(rng, (2, 8), 3) + 2.0 * grain)
    return np.asarray(0.42 + 0.03 * grain + 0.025 * rings)


def _planks(rng: np.random.Generator) -> FloatArray:
    image = _wood(rng)
    height = SIZE // 8
    for row in range(8):
        image[row * height : (row + 1) * height] *= rng.uniform(0.8, 1.2)
        image[row * height : row * height + 2] *= 0.5
        joint = int(rng.integers(0, SIZE - 2))
        image[row * height : (row + 1) * height, joint : joint + 2] *= 0.5
    return image


def _tiles(rng: np.random.Generator) -> FloatArray:
    image = 0.55 + 0.05 * noise(rng, (8, 8), 6, 0.65)
    side = SIZE // 5
    for row in range(6):
        for column in range(6):
            cell = (slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side))
            image[cell] *= rng.uniform(0.88, 1.08)
        image[row * side : row * side + 3] = image[:, row * side : row * side + 3] = 0.33
    return image


def _carpet(rng: np.random.Generator) -> FloatArray:
    return 0.28 + 0.05 * noise(rng, (128, 128), 2, 0.9) + 0.02 * noise(rng, (8, 8), 4)


def _linoleum(rng: np.random.Generator) -> FloatArray:
    image = 0.45 + 0.016 * noise(rng, (16, 32), 5, 0.7)
    _speckle(rng, image, 900, 4, 0.07)
    return image


def _ceiling(rng: np.random.Generator) -> FloatArray:
    image = 0.82 + 0.01 * noise(rng, (64, 64), 3)
    _speckle(rng, image, 1500, 1, 0.10)
    half = SIZE // 2
    for k in (0, half):
        image[k : k + 5] = image[:, k : k + 5] = 0.6
    return image


def _metal(rng: np.random.Generator) -> FloatArray:
    image = 0.48 + 0.015 * noise(rng, (2, 64), 3)
    _speckle(rng, image, 60, 4, 0.08)
    return image


def _cardboard(rng: np.random.Generator) -> FloatArray:
    image = 0.40 + 0.02 * noise(rng, (64, 4), 4) + 0.02 * noise(rng, (4, 4), 4)
    _speckle(rng, image, 120, 5, 0.06)
    return image


def _fabric(rng: np.random.Generator) -> FloatArray:
    weave = np.sin(np.arange(SIZE) * (2 * np.pi * 64 / SIZE))
    return np.asarray(0.22 + 0.02 * weave[None, :] * weave[:, None] + 0.03 * noise(rng, (16, 16), 5, 0.7))


def _white(rng: np.random.Generator) -> FloatArray:
    return np.full((SIZE, SIZE), 0.8)


PATTERNS: dict[str, Pattern] = {
    "plaster": Pattern(_plaster, 1.7),
    "blotches": Pattern(_blotches, 4.3),
    "concrete": Pattern(_concrete, 1.6),
    "brick": Pattern(_brick, 1.0),
    "wood": Pattern(_wood, 1.2),
    "planks": Pattern(_planks, 1.2),
    "tiles": Pattern(_tiles, 1.5),
    "carpet": Pattern(_carpet, 1.1),
    "linoleum": Pattern(_linoleum, 1.6),
    "ceiling": Pattern(_ceiling, 1.25),
    "metal": Pattern(_metal, 0.9),
    "cardboard": Pattern(_cardboard, 0.8),
    "fabric": Pattern(_fabric, 0.6),
    "white": Pattern(_white, 1.0),
}
