# SPDX-License-Identifier: Apache-2.0
"""Depth images in a few kilobytes: levels of equal ratio, and standard deviations that cover the rounding.

A depth d (m) has level 1 + log(d / 0.1) / log(1.005), rounded: 0.25 % of the depth is the largest error, 5 mm at 2 m.
A standard deviation has level 1 + 4 log2(s / 0.1 mm), rounded up, where s^2 is the sensor's variance and the square of
the largest rounding error. Level 0: no reading. Both images of levels are PNG files: depth in 16 bits, sigma in 8.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.types import AnyArray, ByteArray, Float32Array

Levels = npt.NDArray[np.uint16]

NEAREST_M, FARTHEST_M = 0.1, 20.0
_RATIO = np.log(1.005)
_LEAST_SIGMA_M = 1e-4
_SIGMA_STEPS = 4.0
"""Levels of a standard deviation in an octave."""
_MOST_LEVELS = 1 + round(float(np.log(FARTHEST_M / NEAREST_M) / _RATIO))
_PNG_HEAD = struct.Struct(">8s4x4sIIBB")
_PNG = b"\x89PNG\r\n\x1a\n"


def depth_levels(depth: Float32Array, sigma: Float32Array) -> tuple[Levels, ByteArray]:
    """Levels of depth and of its standard deviation, both (height, width) m; what is not finite or too far: none."""
    with np.errstate(invalid="ignore"):
        good = (depth >= NEAREST_M) & (depth <= FARTHEST_M) & (sigma > 0.0) & np.isfinite(sigma)
    d, s = np.where(good, depth, 1.0).astype(np.float64), np.where(good, sigma, 1.0).astype(np.float64)
    levels = 1 + np.rint(np.log(d / NEAREST_M) / _RATIO)
    s = np.hypot(s, np.abs(d - _depth_of(levels)))
    steps = 1 + np.maximum(np.ceil(_SIGMA_STEPS * np.log2(s / _LEAST_SIGMA_M)), 0.0)
    good &= steps <= 255
    return np.where(good, levels, 0).astype(np.uint16), np.where(good, steps, 0).astype(np.uint8)


def depth_of_levels(levels: Levels, steps: ByteArray) -> tuple[Float32Array, Float32Array]:
    """Depth and standard deviation (height, width) m, NaN where there is no reading."""
    good = levels > 0
    depth = np.where(good, _depth_of(levels.astype(np.float64)), np.nan).astype(np.float32)
    sigma = np.where(good, _LEAST_SIGMA_M * np.exp2((steps.astype(np.float64) - 1.0) / _SIGMA_STEPS), np.nan)
    return depth, np.nextafter(sigma.astype(np.float32), np.float32(np.inf))


def pack_levels(levels: Levels, steps: ByteArray) -> tuple[bytes, bytes]:
    """The two PNG files."""
    return _png(levels), _png(steps)


def unpack_levels(depth_file: bytes, sigma_file: bytes, shape: tuple[int, int]) -> tuple[Levels, ByteArray]:
    """Inverse of :func:`pack_levels` for images (height, width).

    Raises
    ------
    ValueError
        If a file is none of this size, or a level is too large, or one image has a reading where the other has none.
    """
    levels, steps = _from_png(depth_file, shape, 16), _from_png(sigma_file, shape, 8)
    if int(levels.max()) > _MOST_LEVELS or ((levels > 0) != (steps > 0)).any():
        raise ValueError("a depth image has levels that cannot be")
    return levels.astype(np.uint16), steps.astype(np.uint8)


def _depth_of(levels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(NEAREST_M * np.exp((levels - 1.0) * _RATIO))


def _png(image: Levels | ByteArray) -> bytes:
    return bytes(cv2.imencode(".png", image, (cv2.IMWRITE_PNG_COMPRESSION, 9))[1])


def _from_png(data: bytes, shape: tuple[int, int], bits: int) -> AnyArray:
    """The grey image of a PNG; its size is read before it is decoded, which takes memory by what the file says."""
    head = _PNG_HEAD.unpack_from(data) if len(data) > _PNG_HEAD.size else ()
    if head != (_PNG, b"IHDR", shape[1], shape[0], bits, 0):
        raise ValueError(f"not a grey PNG of {shape[1]} x {shape[0]} px and {bits} bits")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != shape or image.dtype != (np.uint16 if bits == 16 else np.uint8):
        raise ValueError("a PNG is damaged")
    return np.asarray(image)
