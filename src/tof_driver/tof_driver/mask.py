# SPDX-License-Identifier: Apache-2.0
"""Mask of range pixels that can be believed, with the reason for each one that cannot.

A pixel is judged alone first (no reading, too dark, saturated, out of range, wrapped round the ambiguity range), then
among its neighbours: a pixel at a depth edge mixes the light of foreground and background and flies between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from slam_core.config import Config, parameter
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, Float32Array

MAXIMUM_INCIDENCE_DEG = 75.0
"""Steepest surface, angle between ray and normal, deg."""
NOISE_MULTIPLE = 3.5
"""Difference of neighbours explained by noise, sigma."""
MINIMUM_NEIGHBOURS = 3
"""Number of the eight neighbours that must lie on the same surface."""


class Reason(IntEnum):
    """Reason for which a pixel has no depth; ``VALID`` where it has one."""

    VALID = 0
    NO_READING = 1
    OUT_OF_RANGE = 2
    TOO_DARK = 3
    SATURATED = 4
    WRAPPED = 5
    FLYING = 6


VALID, NO_READING, OUT_OF_RANGE, TOO_DARK, SATURATED, WRAPPED, FLYING = (int(reason) for reason in Reason)


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
    c = config
    limits = (c.minimum_range, c.maximum_range, c.minimum_amplitude, c.minimum_reflectivity, c.white_amplitude)
    saturated = c.saturated_amplitude if c.saturated_amplitude > 0.0 else np.inf
    reason = np.empty(distance.shape, np.uint8)
    light = np.zeros(0, np.float32) if amplitude is None else amplitude.ravel()
    _judge(distance.ravel(), light, np.array([*limits, saturated], np.float32), reason.reshape(-1))
    return reason


@in_place(error_model="numpy")
def _judge(distance, amplitude, limits, reason):  # type: ignore[no-untyped-def]
    """Later tests outdo earlier ones, so that what hides all others is named: no reading, and before it saturation."""
    nearest, farthest, darkest, least_reflectivity, white, saturated = limits
    lit = len(amplitude) > 0
    for i in range(len(distance)):
        r, found = distance[i], np.uint8(VALID)
        if lit:
            light = amplitude[i]
            if light * (r * r) / white < least_reflectivity:
                found = np.uint8(WRAPPED)
            if light < darkest or not np.isfinite(light):
                found = np.uint8(TOO_DARK)
        if r < nearest or r > farthest:
            found = np.uint8(OUT_OF_RANGE)
        if not (np.isfinite(r) and r > np.float32(0.0)):
            found = np.uint8(NO_READING)
        if lit and amplitude[i] >= saturated:
            found = np.uint8(SATURATED)
        reason[i] = found


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
    width = distance.shape[1]
    # Half of the noise of a difference: sqrt(a^2 + b^2) is taken as (a + b) / sqrt(2).
    half = np.float32(NOISE_MULTIPLE / np.sqrt(2.0))
    slope = np.float32(pixel_angle * np.tan(np.radians(MAXIMUM_INCIDENCE_DEG)))
    readings, noise = np.empty((2, 3, width + 2), np.float32)
    jumps, same_surface = np.empty((2, width), np.float32)
    _mark_flying(distance, sigma, half, slope, MINIMUM_NEIGHBOURS, readings, noise, jumps, same_surface, reason)


@in_place()
def _mark_flying(  # type: ignore[no-untyped-def]
    distance, sigma, factor, slope, minimum_neighbours, readings, noise, jumps, same_surface, reason
):
    """Row by row; ``readings`` and ``noise`` (3, width + 2) are room for three rows in a frame of NaN.

    No comparison with NaN holds, so that no border has to be tested for. ``jumps`` and ``same_surface`` (width,) are
    room to count the neighbours of a row's pixels.
    """
    height, width = reason.shape
    readings[:] = np.float32(np.nan)
    noise[:] = np.float32(0.0)
    _take_row(distance, sigma, reason, factor, 0, readings[1], noise[1])
    for v in range(height):
        above, here, below = v % 3, (v + 1) % 3, (v + 2) % 3
        if v + 1 < height:
            _take_row(distance, sigma, reason, factor, v + 1, readings[below], noise[below])
        else:
            readings[below] = np.float32(np.nan)
        _compare(
            readings[above], readings[here], readings[below], noise[above], noise[here], noise[below], slope, jumps,
            same_surface,
        )  # fmt: skip
        for u in range(width):
            if jumps[u] > 0 or same_surface[u] < minimum_neighbours:
                reason[v, u] = FLYING if reason[v, u] == VALID else reason[v, u]


@in_place()
def _take_row(distance, sigma, reason, factor, v, readings, noise):  # type: ignore[no-untyped-def]
    for u in range(reason.shape[1]):
        is_read = reason[v, u] != NO_READING and reason[v, u] != SATURATED
        readings[u + 1] = distance[v, u] if is_read else np.float32(np.nan)
        noise[u + 1] = sigma[v, u] * factor


@in_place()
def _compare(above, here, below, noise_above, noise_here, noise_below, slope, jumps, same_surface):  # type: ignore[no-untyped-def]
    """Count the eight neighbours of a row's pixels that are on another surface and on the same one."""
    width = len(jumps)
    oblique = np.float32(1.4142) * slope
    for u in range(width):
        r, n = here[u + 1], noise_here[u + 1]
        a, b = _judged(r, n, above[u], noise_above[u], oblique)
        c, d = _judged(r, n, above[u + 1], noise_above[u + 1], slope)
        e, f = _judged(r, n, above[u + 2], noise_above[u + 2], oblique)
        g, h = _judged(r, n, here[u], noise_here[u], slope)
        i, j = _judged(r, n, here[u + 2], noise_here[u + 2], slope)
        k, m = _judged(r, n, below[u], noise_below[u], oblique)
        o, p = _judged(r, n, below[u + 1], noise_below[u + 1], slope)
        q, s = _judged(r, n, below[u + 2], noise_below[u + 2], oblique)
        jumps[u] = a + c + e + g + i + k + o + q
        same_surface[u] = b + d + f + h + j + m + p + s


@in_place()
def _judged(reading, noise, other, other_noise, slope):  # type: ignore[no-untyped-def]
    """1 in the first place for a neighbour on another surface, in the second for one on the same, else 0 (NaN)."""
    one, zero = np.float32(1.0), np.float32(0.0)
    difference = abs(other - reading)
    limit = slope * min(reading, other) + noise + other_noise
    return one if difference > limit else zero, one if difference <= limit else zero
