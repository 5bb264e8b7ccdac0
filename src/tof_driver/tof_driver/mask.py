"""Which range pixels can be believed, and the reason for each one that cannot.

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


class Reason(IntEnum):
    """Why a pixel has no depth; ``VALID`` where it has one."""

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
    minimum_amplitude: float = parameter(20.0, "below: too dark; 0 switches the test off", unit="digits", minimum=0.0)
    saturated_amplitude: float = parameter(
        2200.0, "at or above: saturated; 0 switches the test off", unit="digits", minimum=0.0
    )
    white_amplitude: float = parameter(
        1000.0, "amplitude of a white surface at 1 m, seen straight on", unit="digits", minimum=1e-6
    )
    minimum_reflectivity: float = parameter(
        0.02,
        "apparent reflectivity (amplitude x range^2, white wall = 1) below which a range is taken to have wrapped "
        "round the ambiguity range; 0 switches the test off",
        minimum=0.0,
        maximum=1.0,
    )
    flying_pixels: bool = parameter(True, "reject pixels between foreground and background")
    maximum_incidence_deg: float = parameter(
        82.0, "steepest surface, angle between ray and normal", unit="deg", minimum=10.0, maximum=89.5
    )
    noise_multiple: float = parameter(4.0, "difference of neighbours explained by noise", unit="sigma", minimum=1.0)
    minimum_neighbours: int = parameter(
        3, "of the eight neighbours, how many must lie on the same surface", minimum=0, maximum=8
    )


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


def reject_flying_pixels(
    config: MaskConfig, distance: Float32Array, sigma: Float32Array, reason: ByteArray, pixel_angle: float
) -> None:
    """Mark flying pixels in ``reason`` (in place).

    Neighbours are on one surface where their ranges differ by no more than noise and the steepest believable surface
    explain. A pixel flies if

    - it has too few such neighbours, or
    - in one of four directions it lies on a ramp: beyond the one neighbour and short of the other, or
    - it sits at a jump and does not continue the line of its two neighbours on the other side.

    Parameters
    ----------
    config
        Steepest surface, noise multiple and number of neighbours.
    distance, sigma, reason
        Range and its standard deviation (m) and reasons so far, shape (height, width).
    pixel_angle
        Angle between the rays of neighbouring pixels, rad.
    """
    slope = pixel_angle * np.tan(np.radians(config.maximum_incidence_deg))
    flying = _flying(
        distance, sigma, reason, np.float32(slope), np.float32(config.noise_multiple), config.minimum_neighbours
    )
    reason[flying] = Reason.FLYING


@njit(cache=True, nogil=True)
def _flying(distance, sigma, reason, slope, noise_multiple, minimum_neighbours):  # type: ignore[no-untyped-def]
    height, width = distance.shape
    suspect = _suspects(distance, sigma, reason, slope, noise_multiple)
    flying = np.zeros((height, width), dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            if suspect[v, u] and reason[v, u] == 0:
                flying[v, u] = _pixel_flies(distance, sigma, reason, v, u, slope, noise_multiple, minimum_neighbours)
    return flying


@njit(cache=True, nogil=True)
def _suspects(distance, sigma, reason, slope, noise_multiple):  # type: ignore[no-untyped-def]
    """Pixels not surely on one surface with all eight neighbours: few, and the only ones worth the full test."""
    height, width = distance.shape
    suspect = np.ones((height, width), dtype=np.bool_)
    shrink = np.float32(1.0) / (np.float32(1.0) + slope)
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            r = distance[v, u]
            limit = (slope * r + noise_multiple * sigma[v, u]) * shrink
            smooth = True
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    smooth &= (abs(distance[v + dv, u + du] - r) <= limit) & (reason[v + dv, u + du] == 0)
            suspect[v, u] = not smooth
    return suspect


@njit(cache=True, nogil=True)
def _pixel_flies(distance, sigma, reason, v, u, slope, noise_multiple, minimum_neighbours):  # type: ignore[no-untyped-def]
    same_surface = 0
    for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = _jump(distance, sigma, reason, v, u, v + dv, u + du, slope, noise_multiple)
        behind = _jump(distance, sigma, reason, v, u, v - dv, u - du, slope, noise_multiple)
        same_surface += (ahead == 0) + (behind == 0)
        if ahead * behind == -1:
            return True
        if (
            abs(ahead) == 1
            and behind == 0
            and _breaks_line(distance, sigma, reason, v, u, -dv, -du, slope, noise_multiple)
        ):
            return True
        if (
            abs(behind) == 1
            and ahead == 0
            and _breaks_line(distance, sigma, reason, v, u, dv, du, slope, noise_multiple)
        ):
            return True
    return same_surface < minimum_neighbours


@njit(cache=True, nogil=True)
def _jump(distance, sigma, reason, v, u, vn, un, slope, noise_multiple):  # type: ignore[no-untyped-def]
    """0: the neighbour is on the same surface; 1 or -1: beyond or before it; 2: no neighbour."""
    height, width = distance.shape
    if vn < 0 or un < 0 or vn >= height or un >= width or reason[vn, un] != 0:
        return 2
    r, rn = distance[v, u], distance[vn, un]
    steps = 1.0 if v == vn or u == un else 1.4142
    noise = np.sqrt(sigma[v, u] ** 2 + sigma[vn, un] ** 2)
    limit = steps * slope * min(r, rn) + noise_multiple * noise
    if abs(rn - r) <= limit:
        return 0
    return 1 if rn > r else -1


@njit(cache=True, nogil=True)
def _breaks_line(distance, sigma, reason, v, u, dv, du, slope, noise_multiple):  # type: ignore[no-untyped-def]
    """Whether the pixel misses the line through its next two neighbours in a direction; False if they are no line."""
    v1, u1, v2, u2 = v + dv, u + du, v + 2 * dv, u + 2 * du
    if _jump(distance, sigma, reason, v1, u1, v2, u2, slope, noise_multiple) != 0:
        return False
    error = distance[v, u] - 2.0 * distance[v1, u1] + distance[v2, u2]
    variance = sigma[v, u] ** 2 + 4.0 * sigma[v1, u1] ** 2 + sigma[v2, u2] ** 2
    return error * error > noise_multiple * noise_multiple * variance
