# SPDX-License-Identifier: Apache-2.0
"""Mask of range pixels that can be believed, with the reason for each one that cannot.

A pixel is judged alone first (no reading, too dark, saturated, out of range, wrapped round the ambiguity range), then
among its neighbours: a pixel at a depth edge mixes the light of foreground and background and flies between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit

from slam_core.config import Config, parameter
from slam_core.types import ByteArray, Float32Array

MAXIMUM_INCIDENCE_DEG = 75.0
"""Steepest surface, angle between ray and normal, deg."""
NOISE_MULTIPLE = 3.5
"""Difference of neighbours explained by noise, sigma."""
MINIMUM_NEIGHBOURS = 3
"""Of the eight neighbours, how many must lie on the same surface."""


class Reason(IntEnum):
    """Reason for which a pixel has no depth; ``VALID`` where it has one."""

    VALID = 0
    NO_READING = 1
    OUT_OF_RANGE = 2
    TOO_DARK = 3
    SATURATED = 4
    WRAPPED = 5
    FLYING = 6


@dataclass(frozen=True)
class MaskConfig(Config):
    """Limits of a believable range pixel."""

    minimum_range: float = parameter(0.2, "nearest believable range", unit="m", minimum=0.0)
    maximum_range: float = parameter(7.5, "farthest believable range", unit="m", minimum=0.1)
    minimum_amplitude: float = parameter(5.0, "below: too dark; 0 switches the test off", unit="digits", minimum=0.0)
    saturated_amplitude: float = parameter(
        2200.0, "at or above: saturated; 0 switches the test off", unit="digits", minimum=0.0
    )
    white_amplitude: float = parameter(
        1000.0, "amplitude of a white surface at 1 m, seen straight on", unit="digits", minimum=1e-6
    )
    minimum_reflectivity: float = parameter(
        0.07,
        "apparent reflectivity (amplitude x range^2, white wall = 1) below which a range is taken to have wrapped "
        "round the ambiguity range; 0 switches the test off",
        minimum=0.0,
        maximum=1.0,
    )
    flying_pixels: bool = parameter(True, "reject pixels between foreground and background")


def judge_pixels(config: MaskConfig, distance: Float32Array, amplitude: Float32Array | None) -> ByteArray:
    """The :class:`Reason` of each pixel judged alone, uint8, the shape of ``distance``.

    Parameters
    ----------
    config
        Limits of range, amplitude and apparent reflectivity.
    distance
        Range along the ray, m; NaN, infinite or not positive where the sensor has no reading.
    amplitude
        Same shape, digits, or None.
    """
    reason = np.zeros(distance.shape, dtype=np.uint8)
    if amplitude is not None:
        with np.errstate(invalid="ignore", over="ignore"):
            reflectivity = amplitude * np.square(distance) / np.float32(config.white_amplitude)
        reason[reflectivity < config.minimum_reflectivity] = Reason.WRAPPED
        reason[(amplitude < config.minimum_amplitude) | ~np.isfinite(amplitude)] = Reason.TOO_DARK
    reason[(distance < config.minimum_range) | (distance > config.maximum_range)] = Reason.OUT_OF_RANGE
    reason[~(np.isfinite(distance) & (distance > 0.0))] = Reason.NO_READING
    if amplitude is not None and config.saturated_amplitude > 0.0:
        reason[amplitude >= config.saturated_amplitude] = Reason.SATURATED
    return reason


def reject_flying_pixels(distance: Float32Array, sigma: Float32Array, reason: ByteArray, pixel_angle: float) -> None:
    """Mark flying pixels in ``reason`` (in place).

    Neighbours are on one surface where their ranges differ by no more than noise and the steepest believable surface
    explain. A pixel with a neighbour on another surface is at a depth edge: its light is a mixture that no test on the
    range alone tells from a clean one, so all of them go. Neighbours count even where they are too dark or too far to
    be kept, as long as there is a reading. A pixel with few neighbours on its own surface is a speckle and goes too.

    Parameters
    ----------
    distance, sigma, reason
        Range and its standard deviation (m) and reasons so far, shape (height, width).
    pixel_angle
        Angle between the rays of neighbouring pixels, rad.
    """
    read = (reason != Reason.NO_READING) & (reason != Reason.SATURATED)
    # A frame of NaN spares the kernel all tests for borders and missing neighbours: no comparison with NaN holds.
    surrounded = np.pad(np.where(read, distance, np.float32(np.nan)), 1, constant_values=np.nan)
    # Half of the noise of a difference: sqrt(a^2 + b^2) is taken as (a + b) / sqrt(2).
    noise = np.pad(sigma * np.float32(NOISE_MULTIPLE / np.sqrt(2.0)), 1)
    slope = np.float32(pixel_angle * np.tan(np.radians(MAXIMUM_INCIDENCE_DEG)))
    flying = _flying(surrounded, noise, slope, MINIMUM_NEIGHBOURS)
    reason[flying & (reason == Reason.VALID)] = Reason.FLYING


@njit(cache=True, nogil=True)
def _flying(distance, noise, slope, minimum_neighbours):  # type: ignore[no-untyped-def]
    height, width = distance.shape[0] - 2, distance.shape[1] - 2
    flying = np.empty((height, width), dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            r, half = distance[v + 1, u + 1], noise[v + 1, u + 1]
            jumps, same_surface = 0, -1  # the pixel itself is among the nine
            for dv in range(3):
                for du in range(3):
                    other = distance[v + dv, u + du]
                    steps = np.float32(1.4142) if dv != 1 and du != 1 else np.float32(1.0)
                    limit = steps * slope * min(r, other) + half + noise[v + dv, u + du]
                    jumps += abs(other - r) > limit
                    same_surface += abs(other - r) <= limit
            flying[v, u] = jumps > 0 or same_surface < minimum_neighbours
    return flying
