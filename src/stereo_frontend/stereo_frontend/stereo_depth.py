# SPDX-License-Identifier: Apache-2.0
"""Depth of the features of a pair: matched, disparity refined, ``d = f b / (u_left - u_right)`` (Eqs. 4.3-4.4)."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.types import Counters, Float32Array, StereoImages
from stereo_frontend.assembly import DepthEstimate
from stereo_frontend.frontend_config import FrontendConfig
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.stereo.disparity import RefinedDisparity, refine_disparity
from stereo_frontend.stereo.matching import (
    Matches,
    disparity_bounds,
    has_consistent_neighbour,
    match_stereo,
    swapped_share,
)
from stereo_frontend.stereo.pair_clock import PairClock
from stereo_frontend.stereo.pixel_noise import PixelNoise
from stereo_frontend.stereo.self_calibration import StereoSelfCalibration
from stereo_frontend.stereo.two_view_consistency import StereoView
from stereo_frontend.tracking.tracker import Followed

_NEIGHBOURS = 16
"""A match must share its disparity with one of so many neighbours; 0 switches it off."""
_FEW_TRUSTED = 0.1
"""Share of keypoints with a trusted disparity below which the sign of the disparities is questioned."""
_SWAPPED_SHARE = 0.6
_SWAPPED_MATCHES = 30
_FEW_MATCHES, _POOR_PAIRS = 30, 2
"""Matches of a pair, and pairs with fewer in a row, from which on rows are doubted where the images' times differ."""


class StereoDepth:
    """Measures depths in pairs; learns their noise, the error of their rectification and the time between images."""

    def __init__(self, config: FrontendConfig, pool: ThreadPoolExecutor, counters: Counters) -> None:
        self._config = config
        self._pool = pool
        self.counters = counters
        self.noise = PixelNoise(config.noise)
        self.calibration = StereoSelfCalibration(config.self_calibration)
        self.clock = PairClock(config.pair, tracks=config.tracks)
        self._poor_pairs = 0
        self._has_been_right = False
        self._wide = self.calibration.widened(config.matching)

    def reset(self) -> None:
        """Forget noise, the rectification's error and the time between the images."""
        self.noise.reset()
        self.calibration.reset()
        self.clock.reset()
        self._poor_pairs = 0
        self._has_been_right = False

    def learn(self, images: StereoImages, left: Keypoints, refined: RefinedDisparity) -> None:
        """Learn the rectification's error from left keypoints (n), described, and their disparities (n)."""
        self.calibration.learn(self._view(images, left, refined))

    def of_keypoints(
        self, images: StereoImages, left: Keypoints, right: Keypoints
    ) -> tuple[DepthEstimate, RefinedDisparity]:
        """Depth of the left keypoints, and the disparities of those that have one."""
        focal_baseline = images.stereo.camera.fx * images.stereo.baseline
        bounds = disparity_bounds(self._config.matching, focal_baseline)
        matches = self._match(images, left, right, bounds)
        found = left.select(matches.left)
        partner = right.uv[matches.right]
        partner = partner - self.clock.shift(images.stereo, partner, found.uv[:, 0] - partner[:, 0]).uv
        disparity, sigma, refined = self._disparities(images, found.uv, partner, found.size)
        trusted = int(refined.valid.sum())
        if trusted >= _FEW_TRUSTED * len(left):
            self._has_been_right |= trusted >= _SWAPPED_MATCHES
        elif not self._has_been_right:  # later on it is a blank wall, whose noise matches by chance
            self._reject_swapped(left, right, bounds)
        estimate = DepthEstimate.unknown(len(left))
        estimate.depth[matches.left] = images.stereo.depth_from_disparity(disparity)
        estimate.sigma[matches.left] = focal_baseline / disparity**2 * sigma
        self._count(left, right, len(matches), int(np.isfinite(disparity).sum()))
        return estimate, refined.select(np.flatnonzero(np.isfinite(disparity)))

    def of_tracks(self, images: StereoImages, followed: Followed) -> DepthEstimate:
        """Depth by stereo of what was followed, looked for near the predicted depths."""
        uv, disparity = followed.keypoints.uv, images.stereo.camera.fx * images.stereo.baseline / followed.depth
        partner = np.column_stack([uv[:, 0] - disparity, uv[:, 1]]).astype(np.float32)
        disparity, sigma, _ = self._disparities(images, uv, partner)
        self.counters.add("frames")
        self.counters.add("tracks", len(uv))
        estimate = DepthEstimate.unknown(len(uv))
        estimate.depth[:] = images.stereo.depth_from_disparity(disparity)
        estimate.sigma[:] = images.stereo.camera.fx * images.stereo.baseline / disparity**2 * sigma
        return estimate

    def _match(self, images: StereoImages, left: Keypoints, right: Keypoints, bounds: tuple[float, float]) -> Matches:
        """Matches along the rows as they are; those of a first pair are found out with a wider band.

        Rows that were learnt while an image's motion was not known may hide all matches: they are learnt anew then.
        """
        calibration = self.calibration
        late = self.clock.shift(images.stereo, right.uv).uv
        right = dataclasses.replace(right, uv=right.uv - late)
        if self._poor_pairs >= _POOR_PAIRS and self.clock.time_offset != 0.0:
            calibration.reset()
        if not calibration.knows(images.stereo.camera):
            wide = match_stereo(left, right, self._wide, bounds)
            calibration.acquire(self._view_of_keypoints(images, left.select(wide.left), right.select(wide.right)))
        error = calibration.rows(right.uv, np.zeros(len(right)))
        aligned = dataclasses.replace(right, uv=right.uv - np.column_stack([np.zeros_like(error), error]))
        matches = match_stereo(left, aligned, self._config.matching, bounds)
        self._poor_pairs = self._poor_pairs + 1 if len(matches) < _FEW_MATCHES else 0
        return matches

    def _disparities(
        self, images: StereoImages, uv: Float32Array, partner: Float32Array, size: Float32Array | None = None
    ) -> tuple[FloatArray, FloatArray, RefinedDisparity]:
        """Disparities (n,) px of left pixels whose partners would be near ``partner`` (n, 2) px at the left's moment.

        NaN where not trusted. Corrected for what is known of the rectification's error, with their standard deviations;
        and without that correction. ``size`` (n,) px is that of keypoints that were found in both images: their rows
        tell the noise. What was tracked tells the clock.
        """
        calibration, clock, stereo = self.calibration, self.clock, images.stereo
        bounds = disparity_bounds(self._config.matching, stereo.camera.fx * stereo.baseline)
        guess = uv[:, 0] - partner[:, 0]
        row_error, late = calibration.rows(partner, guess), clock.shift(stereo, partner, guess)
        seen = self._refine(images, uv, partner[:, 0] + late.uv[:, 0], row_error + late.uv[:, 1])
        late = clock.shift(stereo, partner, late.without(seen).disparity)
        refined = late.without(seen)
        if size is not None:
            trusted = refined.valid
            self.noise.learn((uv - partner)[trusted, 1] + row_error[trusted], size[trusted])
            self.noise.learn_rectification((refined.row_shift - row_error)[trusted], refined.row_sigma[trusted])
        correction, correction_sigma = calibration.columns(partner)
        disparity = refined.disparity + correction
        disparity[~(disparity >= bounds[0])] = np.nan
        disparity[~has_consistent_neighbour(uv, disparity, _NEIGHBOURS)] = np.nan
        rectification = self.noise.rectification_sigma
        sigma = np.sqrt(refined.sigma**2 + rectification**2 + correction_sigma**2 + late.sigma**2)
        if size is None and clock.learn(stereo, uv, seen, disparity):
            calibration.reset()
        return disparity, sigma, refined

    def _refine(
        self, images: StereoImages, uv: Float32Array, u_right: Float32Array, row_error: Float32Array
    ) -> RefinedDisparity:
        """Half of the matches on each of two threads."""
        left, right = images.left, images.right  # made once, not by either thread

        def part(which: slice) -> RefinedDisparity:
            return refine_disparity(left, right, uv[which], u_right[which], self._config.disparity, row_error[which])

        half = len(uv) // 2
        later = self._pool.submit(part, slice(half, None))
        first = part(slice(half))
        return RefinedDisparity.joined(first, later.result())

    def _view(self, images: StereoImages, left: Keypoints, refined: RefinedDisparity) -> StereoView:
        """View that self-calibration learns from."""
        r = refined
        measured = (left.uv, r.disparity, r.sigma, r.row_shift, r.row_sigma, self.noise.sigma(left.size))
        return StereoView(images.stereo, left.descriptors, *(np.asarray(v, np.float64) for v in measured))

    def _view_of_keypoints(self, images: StereoImages, left: Keypoints, right: Keypoints) -> StereoView:
        """View by keypoints alone, before any alignment of patches."""
        difference, sigma = left.uv - right.uv, self.noise.sigma(left.size)
        unaligned = RefinedDisparity(difference[:, 0], sigma, np.ones_like(sigma), -difference[:, 1], sigma)
        return self._view(images, left, unaligned)

    def _reject_swapped(self, left: Keypoints, right: Keypoints, bounds: tuple[float, float]) -> None:
        share, matches = swapped_share(left, right, self._config.matching, bounds)
        if matches >= _SWAPPED_MATCHES and share > _SWAPPED_SHARE:
            self.counters.add("swapped")
            raise ValueError(
                f"left and right images are swapped: {share:.0%} of {matches} matches have a negative disparity"
            )

    def _count(self, left: Keypoints, right: Keypoints, matched: int, refined: int) -> None:
        self.counters.add("frames")
        self.counters.add("keypoints_left", len(left))
        self.counters.add("keypoints_right", len(right))
        self.counters.add("matched", matched)
        self.counters.add("disparity_rejected", matched - refined)
