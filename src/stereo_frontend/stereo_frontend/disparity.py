"""Sub-pixel disparity by aligning a small patch along the epipolar line, with its variance from what is measured.

Each left patch is registered onto the right image by Gauss-Newton in the inverse-compositional form (Baker and Matthews
2004) with gain and offset of brightness removed. Two unknowns: the horizontal shift, which is what is wanted, and a
vertical one held by a prior, so that a small error of rectification does not leak into the disparity. The residual of
the patch and its curvature give the variance of the shift, ``s^2 (J^T J + prior)^-1``: a flat, noisy or wrongly
modelled patch says so itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from slam_core.config import Config, parameter
from slam_core.types import ByteArray, Float32Array


@dataclass(frozen=True)
class DisparityConfig(Config):
    """The patch alignment and its noise model."""

    radius: int = parameter(5, "half width of the patch", unit="px", minimum=2, maximum=15)
    max_shift: float = parameter(
        3.0, "most correction of the keypoints' disparity", unit="px", minimum=0.1, maximum=20.0
    )
    min_correlation: float = parameter(
        0.8, "least normalised cross-correlation of the aligned patches", minimum=0.0, maximum=1.0
    )
    row_sigma: float = parameter(
        0.3, "standard deviation of the rectification error across the rows", unit="px", minimum=0.01
    )
    sigma_scale: float = parameter(1.0, "factor on the standard deviation from residual and curvature", minimum=0.1)
    sigma_floor: float = parameter(
        0.05, "standard deviation of a perfect patch: sampling and lens", unit="px", minimum=0.001
    )


@dataclass(frozen=True, eq=False)
class RefinedDisparity:
    """disparity (n,) px, NaN where the alignment failed; sigma (n,) px; correlation (n,) of the aligned patches;
    row_shift (n,) px.
    """

    disparity: Float32Array
    sigma: Float32Array
    correlation: Float32Array
    row_shift: Float32Array

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Which alignments converged onto a similar patch."""
        return np.isfinite(self.disparity)


def refine_disparity(
    left: ByteArray, right: ByteArray, uv_left: Float32Array, u_right: Float32Array, config: DisparityConfig
) -> RefinedDisparity:
    """Disparity of keypoints (n, 2) of the left image whose partners lie near column ``u_right`` (n,) of the same
    row.
    """
    out = np.full((len(uv_left), 4), np.nan, np.float32)
    _align_patches(left, right, uv_left, u_right, config.radius, config.max_shift, 1.0 / config.row_sigma**2, out)
    disparity, variance, correlation, row_shift = out.T
    bad = ~(correlation >= config.min_correlation)
    sigma = np.sqrt(config.sigma_scale**2 * variance + config.sigma_floor**2)
    disparity[bad] = np.nan
    return RefinedDisparity(disparity, sigma.astype(np.float32), correlation, row_shift)


@njit(cache=True, nogil=True)
def _align_patches(left, right, uv_left, u_right, radius, max_shift, row_information, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n, 4): disparity, variance from residual and curvature, correlation, row shift; NaN where it
    fails.
    """
    height, width = left.shape
    side = 2 * radius + 1
    n = side * side
    template = np.empty(n, np.float32)
    gx = np.empty(n, np.float32)
    gy = np.empty(n, np.float32)
    patch = np.empty(n, np.float32)
    for k in range(len(uv_left)):
        u0 = int(np.floor(uv_left[k, 0] + 0.5))
        v0 = int(np.floor(uv_left[k, 1] + 0.5))
        if u0 < radius + 1 or v0 < radius + 1 or u0 > width - radius - 2 or v0 > height - radius - 2:
            continue
        _take_template(left, u0, v0, radius, template, gx, gy)
        a, b, c, energy = 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            a += gx[i] * gx[i]
            b += gx[i] * gy[i]
            c += gy[i] * gy[i]
            energy += template[i] * template[i]
        if a < 1.0 or energy < 1.0:
            continue
        start = u_right[k] + (u0 - uv_left[k, 0])
        du, dv, residual, correlation, noise = 0.0, 0.0, 0.0, 0.0, energy / n
        converged = False
        for _ in range(12):
            x = start + du
            y = v0 + dv
            if abs(du) > max_shift or x < radius or y < radius or x >= width - radius - 1 or y >= height - radius - 1:
                break
            _sample_patch(right, x, y, radius, patch)
            cross, power = 0.0, 0.0
            for i in range(n):
                cross += patch[i] * template[i]
                power += patch[i] * patch[i]
            if power < 1.0:
                break
            gain = cross / power
            correlation = cross / np.sqrt(power * energy)
            residual, ex, ey = 0.0, 0.0, 0.0
            for i in range(n):
                r = template[i] - gain * patch[i]
                residual += r * r
                ex += gx[i] * r
                ey += gy[i] * r
            noise = residual / (n - 4) + 0.1
            prior = noise * row_information
            cc = c + prior
            ey -= prior * dv
            determinant = a * cc - b * b
            step_u = (cc * ex - b * ey) / determinant
            step_v = (a * ey - b * ex) / determinant
            if converged:
                break
            length = abs(step_u) + abs(step_v)
            if length > 1.0:
                step_u /= length
                step_v /= length
            du += step_u
            dv += step_v
            converged = length < 0.01
        if converged and abs(du) <= max_shift:
            prior = noise * row_information
            out[k, 0] = u0 - (start + du)
            out[k, 1] = noise * (c + prior) / (a * (c + prior) - b * b)
            out[k, 2] = correlation
            out[k, 3] = dv


@njit(cache=True, nogil=True)
def _take_template(image, u0, v0, radius, template, gx, gy):  # type: ignore[no-untyped-def]
    """Patch around a whole pixel and its central differences, each with its mean removed."""
    i = 0
    mean, mean_x, mean_y = 0.0, 0.0, 0.0
    for v in range(v0 - radius, v0 + radius + 1):
        for u in range(u0 - radius, u0 + radius + 1):
            template[i] = image[v, u]
            gx[i] = 0.5 * (np.float32(image[v, u + 1]) - np.float32(image[v, u - 1]))
            gy[i] = 0.5 * (np.float32(image[v + 1, u]) - np.float32(image[v - 1, u]))
            mean += template[i]
            mean_x += gx[i]
            mean_y += gy[i]
            i += 1
    for j in range(i):
        template[j] -= mean / i
        gx[j] -= mean_x / i
        gy[j] -= mean_y / i


@njit(cache=True, nogil=True)
def _sample_patch(image, x, y, radius, patch):  # type: ignore[no-untyped-def]
    """Bilinear patch around (x, y) with its mean removed."""
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    w00, w01 = (1 - fx) * (1 - fy), fx * (1 - fy)
    w10, w11 = (1 - fx) * fy, fx * fy
    i = 0
    mean = 0.0
    for v in range(y0 - radius, y0 + radius + 1):
        for u in range(x0 - radius, x0 + radius + 1):
            value = w00 * image[v, u] + w01 * image[v, u + 1] + w10 * image[v + 1, u] + w11 * image[v + 1, u + 1]
            patch[i] = value
            mean += value
            i += 1
    for j in range(i):
        patch[j] -= mean / i
