# SPDX-License-Identifier: Apache-2.0
"""Systematic error of a range camera as a linear model: what no averaging removes, and no single image shows.

Range errs by an offset that varies smoothly with range (time offset, modulation that is no pure sine, Lindner and Kolb
2006), by more where the light is weak (light of the smoke or of the camera's own case adds to it), and towards what
surrounds a pixel: light that is scattered in the lens or comes by way of other surfaces has the range of the
surroundings and a detour more, and counts by its share of the pixel's own light (Mure-Dubois and Huegli 2007). So with
range r, weakness w = mean amplitude / amplitude, and amplitude A_k and range r_k of the surroundings at several widths

    error = f(r) + g(r) w + sum_k (a_k + b_k (r_k - r)) A_k / A.

f and g are piecewise linear, smooth by their prior. A camera without amplitude has f alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import EllipsisType

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera
from slam_core.geometry import FloatArray
from slam_core.types import DepthImage, Float32Array

Pixels = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]] | EllipsisType

KNOTS: FloatArray = np.arange(0.0, 10.5, 0.5)
"""Ranges between which f and g are linear, m."""
WIDTHS = (0.05, 0.1, 0.2, 0.4)
"""Standard deviations of the surroundings, as shares of the image's width."""
_SMOOTH = 0.7
"""Length over which f and g change, m."""
_OFFSET_SIGMA, _SHAPE_SIGMA = 0.05, 0.02
"""Prior standard deviations of a constant error and of what varies with range, m."""
_DETOUR_SIGMA, _SHARE_SIGMA = 0.03, 0.05
"""Prior standard deviations of a_k (m) and b_k."""
_WEAKEST = 20.0
"""Greatest w."""
_SMALL = 64
"""Width in which surroundings are computed, px."""


def dimension(has_amplitude: bool) -> int:
    """Number of parameters."""
    return 2 * len(KNOTS) + 2 * len(WIDTHS) if has_amplitude else len(KNOTS)


def prior_covariance(size: int) -> FloatArray:
    """Covariance of so many parameters (:func:`dimension`) of a camera of which nothing is known."""
    apart = (KNOTS[:, None] - KNOTS[None, :]) / _SMOOTH
    shape = _SHAPE_SIGMA**2 * (np.exp(-0.5 * apart**2) + 1e-3 * np.eye(len(KNOTS)))
    out = np.zeros((size, size))
    n = len(KNOTS)
    out[:n, :n] = shape + _OFFSET_SIGMA**2
    if size > n:
        out[n : 2 * n, n : 2 * n] = shape + _SHAPE_SIGMA**2
        np.fill_diagonal(out[2 * n :, 2 * n :], np.repeat([_DETOUR_SIGMA**2, _SHARE_SIGMA**2], len(WIDTHS)))
    return out


@dataclass(frozen=True, eq=False)
class RangeFields:
    """Quantities that the error of each pixel depends on.

    range: (h, w) m along the ray, NaN where there is none. amplitude: (h, w), or None; mean_amplitude is the camera's.
    amplitudes, ranges: A_k and r_k, (h, w) each.
    """

    range: FloatArray
    amplitude: Float32Array | None
    mean_amplitude: float
    amplitudes: list[Float32Array]
    ranges: list[Float32Array]

    @classmethod
    def of(cls, image: DepthImage, mean_amplitude: float) -> RangeFields:
        """Fields of a depth image; ``mean_amplitude`` belongs to the camera, and stays the same."""
        distance = image.depth * ray_length(image.camera)
        around = ([], []) if image.amplitude is None else _surroundings(image.amplitude, distance)
        return cls(distance, image.amplitude, mean_amplitude, *around)

    @property
    def has_amplitude(self) -> bool:
        """True if the error has all its terms."""
        return self.amplitude is not None

    def terms(self, at: Pixels = ...) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Weakness (...), shares ``A_k / A`` and ``(r_k - r) A_k / A`` (k, ...) of pixels, by default of all."""
        assert self.amplitude is not None
        own = np.maximum(self.amplitude[at], np.float32(self.mean_amplitude / _WEAKEST))
        share = np.stack([amplitude[at] for amplitude in self.amplitudes]) / own
        ahead = share * (np.stack([around[at] for around in self.ranges]) - self.range[at])
        return np.asarray(np.float32(self.mean_amplitude) / own), share, ahead

    def rows(self, uv: FloatArray) -> FloatArray:
        """Derivatives (n, parameters) of the error at pixels (n, 2), which must have depth."""
        u, v = np.rint(uv).astype(np.intp).T
        hat = _hats(self.range[v, u])
        if self.amplitude is None:
            return hat
        weakness, share, ahead = self.terms((v, u))
        return np.column_stack([hat, hat * weakness[:, None], share.T, ahead.T])

    def weakness_at(self, uv: FloatArray) -> FloatArray:
        """Weakness (n,) at pixels (n, 2); ones without amplitude."""
        if self.amplitude is None:
            return np.ones(len(uv))
        u, v = np.rint(uv).astype(np.intp).T
        return np.asarray(self.terms((v, u))[0], np.float64)

    def error(self, theta: FloatArray) -> FloatArray:
        """Error (h, w) m of all pixels by parameters; NaN where there is no depth."""
        n, k = len(KNOTS), len(self.amplitudes)
        out = np.interp(self.range, KNOTS, theta[:n])
        if self.amplitude is not None:
            weakness, share, ahead = self.terms()
            out += weakness * np.interp(self.range, KNOTS, theta[n : 2 * n])
            out += np.tensordot(theta[2 * n : 2 * n + k], share, 1)
            out += np.tensordot(theta[2 * n + k :], ahead, 1)
        return np.asarray(out)


@lru_cache(maxsize=4)
def ray_length(camera: Camera) -> FloatArray:
    """Range over depth of each pixel of a camera without distortion, (h, w)."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return np.asarray(np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2))


def _hats(distance: FloatArray) -> FloatArray:
    """Weights (n, knots) of the knots at ranges (n,) m; beyond the last knot its own."""
    inside = np.clip(distance, KNOTS[0], KNOTS[-1])
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(inside[:, None] - KNOTS) / (KNOTS[1] - KNOTS[0])))


def _surroundings(amplitude: Float32Array, distance: FloatArray) -> tuple[list[Float32Array], list[Float32Array]]:
    """Amplitudes and ranges (h, w) around each pixel at the widths, the range weighted by the light."""
    height, width = distance.shape
    size = (_SMALL, max(1, round(_SMALL * height / width)))
    light = np.where(np.isfinite(distance), amplitude, 0.0).astype(np.float32)
    weighted = np.where(np.isfinite(distance), amplitude * distance, 0.0).astype(np.float32)
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (light, weighted)]
    amplitudes, ranges = [], []
    for share in WIDTHS:
        blurred = [cv2.GaussianBlur(image, (0, 0), share * _SMALL) for image in small]
        mean = blurred[1] / np.maximum(blurred[0], np.float32(1e-6))
        full = [cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR) for image in (blurred[0], mean)]
        amplitudes.append(np.asarray(full[0], np.float32))
        ranges.append(np.asarray(full[1], np.float32))
    return amplitudes, ranges
