# SPDX-License-Identifier: Apache-2.0
"""The front end: a stereo pair, a depth image or both become features with depth and honest standard deviations.

``stereo``: features of both images, matched, disparity refined, ``d = f b / (u_left - u_right)`` (Eqs. 4.3-4.4).
``tof``: features and depth of the ToF camera alone. ``replace``: stereo features, depth from the ToF camera where it
sees them (11.2). ``fuse``: both depths weighted by their variances (11.4).
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from slam_core.camera import StereoCamera
from slam_core.geometry import FloatArray
from slam_core.types import Counters, DepthImage, Features, FeatureSource, Float32Array, StereoImages
from stereo_frontend.assembly import DepthEstimate, make_features
from stereo_frontend.depth.depth_fusion import MappedDepth, fuse_depth, map_depth
from stereo_frontend.depth.range_self_calibration import RangeDifferences, RangeSelfCalibration
from stereo_frontend.depth.tof_features import TofFeatures
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend_config import FrontendConfig, FrontendReport
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.stereo.disparity import RefinedDisparity, refine_disparity
from stereo_frontend.stereo.matching import (
    Matches,
    disparity_bounds,
    has_consistent_neighbour,
    is_distinct,
    match_stereo,
    swapped_share,
)
from stereo_frontend.stereo.pixel_noise import PixelNoise
from stereo_frontend.stereo.self_calibration import StereoSelfCalibration
from stereo_frontend.stereo.two_view_consistency import StereoView
from stereo_frontend.tracking.tracked_features import follow_or_detect
from stereo_frontend.tracking.tracker import Followed, Tracker

_MAX_RELATIVE_SIGMA = 0.35
"""Features whose depth sigma exceeds this share of their depth are dropped."""
RIGHT_SURPLUS = 1.6
"""Features wanted in the right image per feature of the left, so that few partners are missing."""
_NEIGHBOURS = 16
"""A match must share its disparity with one of so many neighbours; 0 switches it off."""

_MOST_ALIKE = 0.97
"""Greatest scalar product of the descriptors of two features of an image. Stereo partners are found by another
descriptor; features that this one confuses, like the corners of a tile, would be taken for one another later."""

_FEW_TRUSTED = 0.1
"""Share of keypoints with a trusted disparity below which the sign of the disparities is questioned."""
_SWAPPED_SHARE = 0.6
_SWAPPED_MATCHES = 30


def _more(config: FeatureConfig, factor: float) -> FeatureConfig:
    return dataclasses.replace(config, target=int(factor * config.target))


class Frontend:
    """Processes frames one by one.

    Its state is the detector thresholds and the noise factor, so the same frames in the same order give the same bytes.
    ``counters`` tells what was accepted and rejected since the start.
    """

    def __init__(self, config: FrontendConfig | None = None) -> None:
        self.config = config or FrontendConfig()
        self.counters = Counters()
        features = self.config.features
        self._device = features.open_device()
        self._left = FeatureExtractor(features, for_pairs=True, device=self._device)
        self._right = FeatureExtractor(_more(features, RIGHT_SURPLUS), for_pairs=True, device=self._device)
        self._noise = PixelNoise(self.config.noise)
        self.self_calibration = StereoSelfCalibration(self.config.self_calibration)
        self.range_calibration = RangeSelfCalibration(self.config.range_calibration)
        self._wide = self.self_calibration.widened(self.config.matching)
        self._tracker = Tracker(features.max_tracks) if self.config.tracks else None
        self._tof = TofFeatures(self.config.tof, features, self.config.noise, self._tracker, self._device)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="second_core")

    def process(
        self, images: StereoImages | None, depth: DepthImage | None = None, T_left_tof: FloatArray | None = None
    ) -> Features:
        """Features of one instant: :meth:`extract`, then :meth:`measure`, of the same arguments."""
        return self.measure(self.extract(images), images, depth, T_left_tof)

    def extract(self, images: StereoImages | None) -> tuple[Keypoints, Keypoints] | None:
        """Keypoints of both images, described as far as matching them with each other needs.

        Each image has a thread. None in mode ``tof``, whose keypoints need the depth image. A caller may extract
        from one frame while :meth:`measure` is at the one before.
        """
        if self.config.mode == "tof":
            return None
        if images is None:
            raise ValueError(f"mode '{self.config.mode}' needs a stereo pair, got none")
        return self._extract(images) if self._tracker is None else None

    def _extract(self, images: StereoImages) -> tuple[Keypoints, Keypoints]:
        left = self._pool.submit(self._left, images.left, images.mask)
        right = self._right(images.right)
        return left.result(), right

    def measure(
        self,
        keypoints: tuple[Keypoints, Keypoints] | None,
        images: StereoImages | None,
        depth: DepthImage | None = None,
        T_left_tof: FloatArray | None = None,
    ) -> Features:
        """Keypoints become features: matched, with depth and standard deviations.

        Parameters
        ----------
        keypoints
            What :meth:`extract` found in ``images``.
        images
            Rectified pair; required in every mode but ``tof``.
        depth
            Depth image; required in mode ``tof``. Where it is missing or too old, ``replace`` and ``fuse`` fall back to
            stereo.
        T_left_tof
            Pose (4, 4) of the ToF optical frame in the left optical frame; required with ``depth`` in ``replace`` and
            ``fuse``.

        Raises
        ------
        ValueError
            If a required input is missing, or if left and right images are swapped.
        """
        if self.config.mode == "tof":
            if depth is None:
                raise ValueError("mode 'tof' needs a depth image, got none")
            return self._tof(depth, _MAX_RELATIVE_SIGMA)
        if images is None:
            raise ValueError(f"mode '{self.config.mode}' needs a stereo pair, got none")
        if self._tracker is not None:
            return self._followed(self._tracker, images, depth, T_left_tof)
        if keypoints is None:
            raise ValueError("the keypoints of a pair are missing: extract them first")
        left, estimate = self._measured(images, *keypoints, depth, T_left_tof)
        return self._features(images, left, estimate, np.repeat(self._noise.sigma(left.size)[:, None], 2, axis=1))

    def _features(
        self,
        images: StereoImages,
        left: Keypoints,
        estimate: DepthEstimate,
        sigma_uv: Float32Array,
        track_ids: npt.NDArray[np.int32] | None = None,
    ) -> Features:
        camera, frame_id = images.stereo.camera, "stereo_left_optical_frame"
        return make_features(
            images.stamp_ns, left, estimate, sigma_uv, camera, frame_id, _MAX_RELATIVE_SIGMA, track_ids
        )

    def _measured(
        self,
        images: StereoImages,
        left: Keypoints,
        right: Keypoints,
        depth: DepthImage | None,
        T_left_tof: FloatArray | None,
    ) -> tuple[Keypoints, DepthEstimate]:
        """Left keypoints with their descriptors for other moments, and their depth."""
        stereo, refined = self._stereo_depth(images, left, right)
        estimate = stereo
        if self.config.mode != "stereo":
            estimate = self._with_tof(images, left, stereo, depth, T_left_tof)
        left = self._described(images, left, np.isfinite(stereo.depth) | np.isfinite(estimate.depth))
        self.self_calibration.learn(self._view(images, left.select(np.isfinite(stereo.depth)), refined))
        by_stereo = np.flatnonzero(np.isfinite(stereo.depth))
        estimate.depth[by_stereo[~is_distinct(left.descriptors[by_stereo], _MOST_ALIKE)]] = np.nan
        return left, estimate

    def _followed(
        self, tracker: Tracker, images: StereoImages, depth: DepthImage | None, T_left_tof: FloatArray | None
    ) -> Features:
        """Features of the tracks; of new ones, too, in a frame that has few."""

        def measure(followed: Followed) -> DepthEstimate:
            stereo = self._depth_of_tracks(images, followed)
            if self.config.mode == "stereo":
                return stereo
            return self._with_tof(images, followed.keypoints, stereo, depth, T_left_tof)

        def detect() -> tuple[Keypoints, DepthEstimate]:
            self.counters.add("key_frames")
            return self._measured(images, *self._extract(images), depth, T_left_tof)

        parts = follow_or_detect(
            tracker, images.left, images.stereo.camera, images.stamp_ns, measure, detect, self._noise.sigma, images.mask
        )
        features = [self._features(images, p.keypoints, p.estimate, p.sigma_uv, p.track_ids) for p in parts]
        return features[0] if len(features) == 1 else features[0].joined(features[1])

    def _depth_of_tracks(self, images: StereoImages, followed: Followed) -> DepthEstimate:
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

    def _disparities(
        self, images: StereoImages, uv: Float32Array, partner: Float32Array, size: Float32Array | None = None
    ) -> tuple[FloatArray, FloatArray, RefinedDisparity]:
        """Disparities (n,) px of left pixels whose partners are near ``partner`` (n, 2) px, NaN where not trusted.

        Corrected for what is known of the rectification's error, with their standard deviations; and as measured.
        ``size`` (n,) px is that of keypoints that were found in both images: their rows tell the noise.
        """
        calibration = self.self_calibration
        bounds = disparity_bounds(self.config.matching, images.stereo.camera.fx * images.stereo.baseline)
        row_error = calibration.rows(partner, uv[:, 0] - partner[:, 0])
        refined = self._refine(images, uv, partner[:, 0], row_error)
        if size is not None:
            trusted = refined.valid
            self._noise.learn((uv - partner)[trusted, 1] + row_error[trusted], size[trusted])
            self._noise.learn_rectification((refined.row_shift - row_error)[trusted], refined.row_sigma[trusted])
        correction, correction_sigma = calibration.columns(partner)
        disparity = refined.disparity + correction
        disparity[~(disparity >= bounds[0])] = np.nan
        disparity[~has_consistent_neighbour(uv, disparity, _NEIGHBOURS)] = np.nan
        sigma = np.sqrt(refined.sigma**2 + self._noise.rectification_sigma**2 + correction_sigma**2)
        return disparity, sigma, refined

    def reset(self) -> None:
        """Forget thresholds, noise and counts."""
        for part in (self._left, self._right, self._noise, self.self_calibration, self.range_calibration, self._tof):
            part.reset()
        if self._tracker is not None:
            self._tracker.reset()
        self.counters = Counters()

    @property
    def masked(self) -> int:
        """Keypoints left out so far because they lie in masks."""
        return self._left.masked + self._tof.masked

    def report(self) -> FrontendReport:
        """Findings about the images so far."""
        stereo, ranges, device = self.self_calibration, self.range_calibration, self._device
        advice = tuple(filter(None, (device.diagnostic, stereo.advice(), ranges.advice(), self._tof.advice())))
        picture = "+".join(self._tof.used) if self.config.mode == "tof" else "stereo"
        error = stereo.error if stereo.corrects else None
        return FrontendReport(
            stereo.figures(), advice, picture, error, ranges.figures(), device.name, device.diagnostic
        )

    def _described(self, images: StereoImages, left: Keypoints, needed: npt.NDArray[np.bool_]) -> Keypoints:
        """The left keypoints with descriptors for other moments: of those ``needed``, zeros for the others."""
        described = self._left.describe(images.left, left.select(needed)).descriptors
        descriptors = np.zeros((len(left), described.shape[1]), np.float32)
        descriptors[needed] = described
        return dataclasses.replace(left, descriptors=descriptors)

    def _stereo_depth(
        self, images: StereoImages, left: Keypoints, right: Keypoints
    ) -> tuple[DepthEstimate, RefinedDisparity]:
        """Depth of the left keypoints, and the disparities of those that have one."""
        focal_baseline = images.stereo.camera.fx * images.stereo.baseline
        bounds = disparity_bounds(self.config.matching, focal_baseline)
        matches = self._match(images, left, right, bounds)
        found = left.select(matches.left)
        disparity, sigma, refined = self._disparities(images, found.uv, right.uv[matches.right], found.size)
        if refined.valid.sum() < _FEW_TRUSTED * len(left):
            self._reject_swapped(left, right, bounds)
        estimate = DepthEstimate.unknown(len(left))
        estimate.depth[matches.left] = images.stereo.depth_from_disparity(disparity)
        estimate.sigma[matches.left] = focal_baseline / disparity**2 * sigma
        self._count(left, right, len(matches), int(np.isfinite(disparity).sum()))
        return estimate, refined.select(np.flatnonzero(np.isfinite(disparity)))

    def _match(self, images: StereoImages, left: Keypoints, right: Keypoints, bounds: tuple[float, float]) -> Matches:
        """Matches along the rows as they are; those of a first pair are found out with a wider band."""
        calibration = self.self_calibration
        if not calibration.knows(images.stereo.camera):
            wide = match_stereo(left, right, self._wide, bounds)
            calibration.acquire(self._view_of_keypoints(images, left.select(wide.left), right.select(wide.right)))
        error = calibration.rows(right.uv, np.zeros(len(right)))
        aligned = dataclasses.replace(right, uv=right.uv - np.column_stack([np.zeros_like(error), error]))
        return match_stereo(left, aligned, self.config.matching, bounds)

    def _view(self, images: StereoImages, left: Keypoints, refined: RefinedDisparity) -> StereoView:
        """View that self-calibration learns from."""
        r = refined
        measured = (left.uv, r.disparity, r.sigma, r.row_shift, r.row_sigma, self._noise.sigma(left.size))
        return StereoView(images.stereo, left.descriptors, *(np.asarray(v, np.float64) for v in measured))

    def _view_of_keypoints(self, images: StereoImages, left: Keypoints, right: Keypoints) -> StereoView:
        """View by keypoints alone, before any alignment of patches."""
        difference, sigma = left.uv - right.uv, self._noise.sigma(left.size)
        unaligned = RefinedDisparity(difference[:, 0], sigma, np.ones_like(sigma), -difference[:, 1], sigma)
        return self._view(images, left, unaligned)

    def _refine(
        self, images: StereoImages, uv: Float32Array, u_right: Float32Array, row_error: Float32Array
    ) -> RefinedDisparity:
        """Half of the matches on each of two threads."""

        def part(which: slice) -> RefinedDisparity:
            return refine_disparity(
                images.left, images.right, uv[which], u_right[which], self.config.disparity, row_error[which]
            )

        half = len(uv) // 2
        later = self._pool.submit(part, slice(half, None))
        first = part(slice(half))
        return RefinedDisparity.joined(first, later.result())

    def _with_tof(
        self,
        images: StereoImages,
        left: Keypoints,
        stereo: DepthEstimate,
        depth: DepthImage | None,
        T: FloatArray | None,
    ) -> DepthEstimate:
        tof = self._map_tof(images, left, stereo, depth, T)
        if tof is None:
            return stereo
        seen = np.isfinite(tof.depth)
        alone = seen & ~np.isfinite(stereo.depth) if self.config.mode == "fuse" else seen
        fused, sigma, agrees = fuse_depth(stereo.depth, stereo.sigma, tof, self.config.fusion.gate)
        if self.config.mode == "replace":
            agrees = np.zeros_like(seen)
        self.counters.add("fused", int(agrees.sum()))
        self.counters.add("tof_alone", int(alone.sum()))
        source = np.where(alone, FeatureSource.TOF, np.where(agrees, FeatureSource.FUSED, stereo.source)).astype(
            np.uint8
        )
        return DepthEstimate(
            np.where(alone, tof.depth, np.where(agrees, fused, stereo.depth)),
            np.where(alone, tof.sigma, np.where(agrees, sigma, stereo.sigma)),
            source,
        )

    def _map_tof(
        self,
        images: StereoImages,
        left: Keypoints,
        stereo: DepthEstimate,
        depth: DepthImage | None,
        T: FloatArray | None,
    ) -> MappedDepth | None:
        if depth is None:
            self.counters.add("tof_missing")
            return None
        if T is None:
            raise ValueError(f"mode '{self.config.mode}' needs T_left_tof: a missing transform is never identity")
        age = abs(depth.stamp_ns - images.stamp_ns) * 1e-9
        if age > self.config.fusion.max_age:
            self.counters.add("tof_too_old")
            return None
        return self._map_corrected(left.uv, stereo, images.stereo, depth, T, age)

    def _map_corrected(
        self, uv: Float32Array, stereo: DepthEstimate, pair: StereoCamera, depth: DepthImage, T: FloatArray, age: float
    ) -> MappedDepth:
        """Depth of left pixels with what is known of the range camera's errors, which what both see tells."""
        calibration = self.range_calibration
        fields = calibration.look(depth)
        mapped = map_depth(uv, stereo.depth, pair.camera, calibration.corrected(depth, fields), T, age)
        if fields is None:
            return mapped
        seen = np.flatnonzero(np.isfinite(mapped.depth))
        sigma = mapped.sigma.copy()
        sigma[seen] = np.hypot(sigma[seen], calibration.sigma(fields, mapped.uv[seen]) / mapped.ray_length[seen])
        both = seen[np.isfinite(stereo.depth[seen])]
        depths, sigmas = (
            np.column_stack([getattr(e, name)[both] for e in (mapped, stereo)]) for name in ("depth", "sigma")
        )
        differences = RangeDifferences.between(mapped.uv[both], depths, sigmas, mapped.ray_length[both])
        calibration.learn(depth, fields, differences)
        return dataclasses.replace(mapped, sigma=sigma)

    def _reject_swapped(self, left: Keypoints, right: Keypoints, bounds: tuple[float, float]) -> None:
        share, matches = swapped_share(left, right, self.config.matching, bounds)
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
