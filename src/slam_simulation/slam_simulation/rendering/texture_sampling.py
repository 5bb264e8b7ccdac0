# SPDX-License-Identifier: Apache-2.0
"""Reading a texture over a pixel's footprint: bilinear, trilinear, and several trilinear samples along the longer side.

A pixel's footprint on a surface is a parallelogram. The texture is read along its longer side with several trilinear
samples of the level that fits the shorter one (Heckbert 1989): sharp where a wall recedes, and still free of aliasing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.types import ByteArray

MAX_SAMPLES = 4


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def interpolate(
    values: npt.NDArray[np.number], a: int, b: int, c: int, d: int, x: float, y: float
) -> float:  # pragma: no cover - compiled
    """Bilinear mean at (x, y), 0 to 1, of four flat positions: upper left and right, lower left and right."""
    upper = values[a] * (1.0 - x) + values[b] * x
    lower = values[c] * (1.0 - x) + values[d] * x
    return float(upper * (1.0 - y) + lower * y)


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
    return interpolate(texels, top + x0, top + x1, bottom + x0, bottom + x1, ax, ay)


@njit(cache=True, nogil=True, error_model="numpy")
def trilinear(
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


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
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
    """Mean of texture ``t``, 0 to 1, over a parallelogram around (u, v).

    Its sides are (au, av), (bu, bv), in repetitions.
    """
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
        return float(trilinear(texels, index, t, u, v, level))
    total = 0.0
    for k in range(count):
        s = (k + 0.5) / count - 0.5
        total += trilinear(texels, index, t, u + s * au, v + s * av, level)
    return total / count
