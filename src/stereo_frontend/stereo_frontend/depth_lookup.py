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
from slam_core.types import DepthImage

_MAX_MISFIT = 4.0
"""Greatest deviation of a pixel from the local plane, in its sigma."""
_MIN_STEP = 0.005
"""Deviations below this share of the depth are never an edge."""
_MAX_SLOPE = 0.06
"""Greatest change of depth per pixel, as a share of depth."""

_DU, _DV = (g.ravel() for g in np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]))
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
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    centre, inside = _nearest_inner_pixels(uv, image.depth.shape)
    u = centre[:, 0, None] + _DU.astype(np.intp)
    v = centre[:, 1, None] + _DV.astype(np.intp)
    depth = image.depth[v, u].astype(np.float64)
    sigma = image.sigma[v, u].astype(np.float64)
    usable = inside & np.all(np.isfinite(depth) & (depth > 0.0) & np.isfinite(sigma), axis=1)
    depth[~usable], sigma[~usable] = 1.0, 1.0
    return _fit_plane(depth, sigma, uv - centre, usable)


def _nearest_inner_pixels(uv: FloatArray, shape: tuple[int, ...]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    limit = np.array([shape[1] - 2, shape[0] - 2])
    finite = np.where(np.isfinite(uv), uv, -1.0)
    rounded = np.floor(np.clip(finite, -1e6, 1e6) + 0.5).astype(np.intp)
    inside = np.all((rounded >= 1) & (rounded <= limit), axis=1)
    return np.clip(rounded, 1, np.maximum(limit, 1)), inside


def _fit_plane(
    depth: FloatArray,
    sigma: FloatArray,
    offset: FloatArray,
    usable: npt.NDArray[np.bool_],
) -> DepthSamples:
    inverse = 1.0 / depth
    mean, slope_u, slope_v = inverse.mean(axis=1), inverse @ _DU / 6.0, inverse @ _DV / 6.0
    fitted = mean[:, None] + slope_u[:, None] * _DU + slope_v[:, None] * _DV
    value = mean + slope_u * offset[:, 0] + slope_v * offset[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1.0 / value
        step = np.abs(inverse - fitted) * z[:, None] ** 2
        gradient = -np.column_stack([slope_u, slope_v]) * z[:, None] ** 2
    limit = np.maximum(_MAX_MISFIT * sigma, _MIN_STEP * z[:, None])
    smooth = np.all(step <= limit, axis=1) & np.all(np.abs(gradient) <= _MAX_SLOPE * z[:, None], axis=1)
    ok = usable & smooth & (value > 0.0) & (depth.min(axis=1) * 0.9 <= z) & (z <= depth.max(axis=1) * 1.1)
    pixel_variance = (sigma**2).mean(axis=1)
    misfit = (step**2).sum(axis=1) / _FREEDOM
    variance = _variance_of_fit(pixel_variance, misfit, (offset**2).sum(axis=1), ok)
    blank = np.where(ok, 0.0, np.nan)
    return DepthSamples(z + blank, np.sqrt(variance) + blank, gradient + blank[:, None])


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
