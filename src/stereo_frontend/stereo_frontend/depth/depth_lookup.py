# SPDX-License-Identifier: Apache-2.0
"""Depth at sub-pixel positions of a depth image, safe at edges.

Over a plane the *inverse* depth is affine in the pixel, whatever the slant. So a plane of inverse depth is fitted to
the 3x3 pixels around a position: it averages the noise, interpolates without bias, gives the gradient that turns pixel
errors into depth errors, and its misfit shows a depth edge, where any interpolation would invent a surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import DepthImage

_MAX_MISFIT = 4.0
"""Greatest deviation of a pixel from the local plane, in its sigma."""
_MIN_STEP = 0.005
"""Deviations below this share of the depth are never an edge."""
_MAX_SLOPE = 0.06
"""Greatest change of depth per pixel, as a share of depth."""

_FREEDOM = 6
"""Nine pixels less the three numbers of the plane."""
_MEDIAN_CHI_SQUARE, _HIGH_CHI_SQUARE = 0.891, 2.099
"""Median and 95 % bound of chi-square over its freedom of six."""


@dataclass(frozen=True, eq=False)
class DepthSamples:
    """depth (n,) m along z, NaN where there is no single surface; sigma (n,) m; gradient (n, 2) m/px along u and v."""

    depth: FloatArray
    sigma: FloatArray
    gradient: FloatArray


def sample_depth(image: DepthImage, uv: npt.ArrayLike) -> DepthSamples:
    """Depth of positions (n, 2) px; positions outside the image or beside missing pixels are NaN."""
    planes = _planes(image, uv)
    depth, gradient, (pixel_variance, misfit, offset_squared) = planes[:, 0], planes[:, 1:3], planes[:, 3:].T
    variance = _variance_of_fit(pixel_variance, misfit, offset_squared, np.isfinite(depth))
    return DepthSamples(depth, np.sqrt(variance), gradient)


def has_depth(image: DepthImage, uv: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """True (n,) where :func:`sample_depth` finds the depth of a position (n, 2) px."""
    return np.asarray(np.isfinite(_planes(image, uv)[:, 0]))


def _planes(image: DepthImage, uv: npt.ArrayLike) -> FloatArray:
    """The numbers (n, 6) of :func:`_fit_planes` at positions (n, 2) px, NaN where there is no single surface."""
    uv = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 2)
    planes = np.full((len(uv), 6), np.nan)
    _fit_planes(image.depth, image.sigma, uv, planes)
    return planes


@in_place(error_model="numpy")
def _fit_planes(depth, sigma, uv, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 6) where there is one surface: depth, its gradient (2,), and what the variance is made of.

    Those are the pixels' mean variance, the misfit per freedom, both m2, and the squared distance to the middle pixel.
    """
    for i in range(len(uv)):
        plane = fit_plane(depth, sigma, uv[i, 0], uv[i, 1])
        if plane[0] > 0.0:
            for j in range(6):
                out[i, j] = plane[j]


@in_place(error_model="numpy")
def fit_plane(depth, sigma, u, v):  # type: ignore[no-untyped-def]
    """The six numbers of :func:`_fit_planes` at a position, px; all 0 where there is no single surface."""
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    height, width = depth.shape
    if not (0.5 <= u < width - 1.5 and 0.5 <= v < height - 1.5):
        return nothing
    u0, v0 = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    mean, slope_u, slope_v, nearest, farthest = 0.0, 0.0, 0.0, np.inf, 0.0
    for j in range(-1, 2):
        for i in range(-1, 2):
            z = np.float64(depth[v0 + j, u0 + i])
            if not (0.0 < z < np.inf and np.isfinite(sigma[v0 + j, u0 + i])):
                return nothing
            mean, slope_u, slope_v = mean + 1.0 / z, slope_u + i / z, slope_v + j / z
            nearest, farthest = min(nearest, z), max(farthest, z)
    mean, slope_u, slope_v = mean / 9.0, slope_u / 6.0, slope_v / 6.0
    du, dv = u - u0, v - v0
    value = mean + slope_u * du + slope_v * dv
    z = 1.0 / value
    gradient_u, gradient_v = -slope_u * z * z, -slope_v * z * z
    if not (value > 0.0 and nearest * 0.9 <= z <= farthest * 1.1):
        return nothing
    if not (abs(gradient_u) <= _MAX_SLOPE * z and abs(gradient_v) <= _MAX_SLOPE * z):
        return nothing
    variance, misfit = 0.0, 0.0
    for j in range(-1, 2):
        for i in range(-1, 2):
            noise = np.float64(sigma[v0 + j, u0 + i])
            fitted = mean + slope_u * i + slope_v * j
            step = abs(1.0 / np.float64(depth[v0 + j, u0 + i]) - fitted) * z * z
            if not step <= max(_MAX_MISFIT * noise, _MIN_STEP * z):
                return nothing
            variance, misfit = variance + noise * noise, misfit + step * step
    return z, gradient_u, gradient_v, variance / 9.0, misfit / _FREEDOM, du * du + dv * dv


def _variance_of_fit(
    pixel_variance: FloatArray, misfit: FloatArray, offset_squared: FloatArray, ok: npt.NDArray[np.bool_]
) -> FloatArray:
    """Variance of the plane at the offset.

    Rectification makes neighbours share noise, which leaves less misfit than the pixels' variance promises. With a
    correlation rho of direct neighbours and ``m = 1 + 4 rho / 3``, the fit takes ``(m^2 + 2 m) / 9`` of the variance
    instead of 1/3: the median misfit gives m. Misfit beyond the 95 % bound of noise is a bent surface, and counts.
    """
    share = 1.0
    if ok.any():
        share = float(np.clip(np.median(misfit[ok] / pixel_variance[ok]) / _MEDIAN_CHI_SQUARE, 0.0, 1.0))
    m = np.sqrt(10.0 - 6.0 * share) - 1.0
    noise = (m * m / 9.0 + m * offset_squared / 6.0) * pixel_variance
    return np.asarray(noise + np.maximum(0.0, misfit - _HIGH_CHI_SQUARE * pixel_variance))
