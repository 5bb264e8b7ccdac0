# SPDX-License-Identifier: Apache-2.0
"""Sub-pixel disparity by aligning a small patch along the epipolar line, with its variance from what is measured.

Each left patch is registered onto the right image by Gauss-Newton on the template's gradient (Baker and Matthews 2004),
gain and offset of brightness removed. Four unknowns: the disparity at the keypoint, which is what is wanted; its two
slopes across the patch, because floors and walls are seen at an angle; and a shift across the rows, so that a small
error of rectification does not leak into the disparity. The last three are held by priors. The residual of the patch
and its curvature give the variance, ``s^2 (J^T J + prior)^-1``: a flat, noisy or wrongly modelled patch says so itself.

At the edge of an object the patch holds two disparities and fits one of them well. So every alignment is repeated from
the right image back to the left, and with a smaller patch: where these disagree, the match is dropped; small
disagreements widen the variance. On simulated rooms that removes two thirds of the errors above one pixel for a sixth
of the matches.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, parameter
from slam_core.types import ByteArray, Float32Array
from stereo_frontend.stereo.patch_alignment import align_patches

_INNER_RADIUS = 5
"""Half width of the smaller patch that must agree, px."""
_MAX_SHIFT = 3.0
"""Most correction of the keypoints' disparity, px."""
_MIN_CORRELATION = 0.8
"""Least normalised cross-correlation of the aligned patches."""
_MAX_DISAGREEMENT = 2.0
"""Most difference of the three alignments, in their standard deviations."""
_SLOPE_SIGMA = 0.15
"""Standard deviation of the change of disparity per pixel; 0.1 is a floor seen from 10 baselines above."""
_SIGMA_SCALE = 1.15
"""Factor on the standard deviation from residual and curvature."""

_DISAGREEMENT_WEIGHT = 0.3
"""Share of a disagreement that enters the standard deviation."""


@dataclass(frozen=True)
class DisparityConfig(Config):
    """The patch alignment and its noise model."""

    radius: int = parameter(7, "half width of the patch", unit="px", minimum=2, maximum=15)
    row_sigma: float = 0.3
    """Standard deviation of the rectification error across the rows, px."""
    sigma_floor: float = 0.02
    """Standard deviation of a perfect patch, px."""


@dataclass(frozen=True, eq=False)
class RefinedDisparity:
    """Result of n alignments.

    disparity (n,) px, NaN where it failed or is not trusted; sigma (n,) px; correlation (n,) of the aligned patches;
    row_shift (n,) px, row of the partner minus row of the keypoint, with row_sigma (n,) px.
    """

    disparity: Float32Array
    sigma: Float32Array
    correlation: Float32Array
    row_shift: Float32Array
    row_sigma: Float32Array

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Mask of the alignments that are trusted."""
        return np.isfinite(self.disparity)

    def select(self, index: npt.NDArray[np.intp]) -> RefinedDisparity:
        """The alignments at ``index``."""
        return RefinedDisparity(*(getattr(self, field.name)[index] for field in dataclasses.fields(self)))

    @staticmethod
    def joined(first: RefinedDisparity, second: RefinedDisparity) -> RefinedDisparity:
        """The alignments of both, one after the other."""
        names = [field.name for field in dataclasses.fields(first)]
        return RefinedDisparity(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in names))


def refine_disparity(
    left: ByteArray,
    right: ByteArray,
    uv_left: Float32Array,
    u_right: Float32Array,
    config: DisparityConfig,
    row_offset: Float32Array | None = None,
) -> RefinedDisparity:
    """Disparity of keypoints (n, 2) of the left image.

    Their partners lie near column ``u_right`` (n,), ``row_offset`` (n,) px lower; by default on the same row, as
    rectified pairs should be.
    """
    row_offset = np.zeros(len(uv_left), np.float32) if row_offset is None else row_offset
    found = _align(left, right, uv_left, u_right, row_offset, config.radius, config)
    partner = uv_left - np.column_stack([found.disparity, -found.row_shift])
    back = _align(right, left, partner, uv_left[:, 0], -row_offset, config.radius, config)
    there_and_back = found.disparity + back.disparity
    agrees = np.abs(there_and_back) <= _MAX_DISAGREEMENT * found.sigma
    u_inner = np.where(agrees, partner[:, 0], np.float32(np.nan))
    inner = _align(left, right, uv_left, u_inner, row_offset, _INNER_RADIUS, config)
    inner_outer = found.disparity - inner.disparity
    agrees &= np.abs(inner_outer) <= _MAX_DISAGREEMENT * inner.sigma
    disagreement = _DISAGREEMENT_WEIGHT * np.hypot(there_and_back, inner_outer)
    disparity = np.where(agrees, found.disparity, np.float32(np.nan))
    sigma = np.hypot(found.sigma, disagreement)
    return dataclasses.replace(found, disparity=disparity, sigma=sigma)


def _align(
    template: ByteArray,
    image: ByteArray,
    uv: Float32Array,
    u_start: Float32Array,
    row_offset: Float32Array,
    radius: int,
    config: DisparityConfig,
) -> RefinedDisparity:
    """One pass over all patches of ``template``, (n, 2) px; NaN positions stay NaN."""
    slope = 1.0 / _SLOPE_SIGMA**2
    information = np.array([0.0, 1.0 / config.row_sigma**2, slope, slope])
    out = np.full((len(uv), 5), np.nan, np.float32)
    align_patches(template, image, uv, u_start, row_offset, radius, _MAX_SHIFT, information, out)
    out[~(out[:, 2] >= _MIN_CORRELATION)] = np.nan
    disparity, variance, correlation, row_shift, row_variance = out.T
    sigma = np.sqrt(_SIGMA_SCALE**2 * variance + config.sigma_floor**2).astype(np.float32)
    return RefinedDisparity(disparity, sigma, correlation, row_shift, np.sqrt(row_variance))
