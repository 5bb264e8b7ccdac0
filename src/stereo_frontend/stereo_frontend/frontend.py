# SPDX-License-Identifier: Apache-2.0
"""The front end: a stereo pair, a depth image or both become features with depth and honest standard deviations.

``stereo``: features of both images, matched, with the depth of their disparities. ``tof``: features and depth of the
ToF camera alone. ``replace``: stereo features, depth from the ToF camera where it sees them (11.2). ``fuse``: both
depths weighted by their variances (11.4).
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from slam_core.geometry import FloatArray
from slam_core.types import Counters, DepthImage, Features, StereoImages
from stereo_frontend.assembly import DepthEstimate, MeasuredKeypoints, joined_features
from stereo_frontend.depth.tof_features import TOF_LONGEST_STEP_S, TofFeatures
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.frontend_config import FrontendConfig, FrontendReport
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.stereo.matching import is_distinct
from stereo_frontend.stereo.pair_clock import PairClock
from stereo_frontend.stereo.self_calibration import StereoSelfCalibration
from stereo_frontend.stereo_depth import StereoDepth
from stereo_frontend.tof_depth import TofDepth
from stereo_frontend.tracking.mapping_pace import MappingPace
from stereo_frontend.tracking.tracked_features import begun, followed, pose_only
from stereo_frontend.tracking.tracker import LONGEST_STEP_S, Tracker

_MAX_RELATIVE_SIGMA = 0.35
"""Features whose depth sigma exceeds this share of their depth are dropped."""
RIGHT_SURPLUS = 1.6
"""Features wanted in the right image per feature of the left, so that few partners are missing."""
_MOST_ALIKE = 0.97
"""Greatest scalar product of the descriptors of two features of an image. Stereo partners are found by another
descriptor; features that this one confuses, like the corners of a tile, would be taken for one another later."""


def _more(config: FeatureConfig, factor: float) -> FeatureConfig:
    return dataclasses.replace(config, target=int(factor * config.target))


class Frontend:
    """Processes frames one by one.

    Its state are detector thresholds, tracks and what is learnt of the cameras (noise, rectification, ranges, the time
    between a pair's images), so the same frames in the same order give the same bytes.
    ``counters`` tells what was accepted and rejected since the start.
    """

    def __init__(self, config: FrontendConfig | None = None) -> None:
        self.config = config or FrontendConfig()
        self.counters = Counters()
        features = self.config.features
        self._device = features.open_device()
        self._left = FeatureExtractor(features, for_pairs=True, device=self._device)
        self._right = FeatureExtractor(_more(features, RIGHT_SURPLUS), for_pairs=True, device=self._device)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="second_core")
        self._stereo_depth = StereoDepth(self.config, self._pool, self.counters)
        self._tof_depth = TofDepth(self.config, self.counters)
        longest_step_s = TOF_LONGEST_STEP_S if self.config.mode == "tof" else LONGEST_STEP_S
        self._tracker = Tracker(features.max_tracks, longest_step_s) if self.config.tracks else None
        self._pace = MappingPace(features.mapping_interval)
        self._tof = TofFeatures(self.config.tof, features, self.config.noise, self._tracker, self._pace, self._device)

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
            parts = self._tracked(self._tracker, images, depth, T_left_tof)
        elif keypoints is None:
            raise ValueError("the keypoints of a pair are missing: extract them first")
        else:
            left, estimate = self._detected(images, keypoints, depth, T_left_tof)
            parts = [MeasuredKeypoints.untracked(left, estimate, self._stereo_depth.noise.sigma(left.size))]
        camera, frame_id = images.stereo.camera, "stereo_left_optical_frame"
        return joined_features(parts, images.stamp_ns, camera, frame_id, _MAX_RELATIVE_SIGMA)

    def _detected(
        self,
        images: StereoImages,
        keypoints: tuple[Keypoints, Keypoints],
        depth: DepthImage | None,
        T_left_tof: FloatArray | None,
    ) -> tuple[Keypoints, DepthEstimate]:
        """Left keypoints with their descriptors for other moments, and their depth."""
        left, right = keypoints
        stereo, refined = self._stereo_depth.of_keypoints(images, left, right)
        estimate = self._tof_depth.added_to(stereo, left.uv, images, depth, T_left_tof)
        by_stereo = np.flatnonzero(np.isfinite(stereo.depth))
        left = self._described(images, left, np.isfinite(stereo.depth) | np.isfinite(estimate.depth))
        self._stereo_depth.learn(images, left.select(by_stereo), refined)
        estimate.depth[by_stereo[~is_distinct(left.descriptors[by_stereo], _MOST_ALIKE)]] = np.nan
        return left, estimate

    def _tracked(
        self, tracker: Tracker, images: StereoImages, depth: DepthImage | None, T_left_tof: FloatArray | None
    ) -> list[MeasuredKeypoints]:
        """Tracks that were followed into the pair; new keypoints, too, in a frame that maps and has few of them."""
        camera, sigma = images.stereo.camera, self._stereo_depth.noise.sigma
        tracks = tracker.follow(images.left, camera, images.stamp_ns, images.mask)
        age_s = np.inf if depth is None else 1e-9 * abs(depth.stamp_ns - images.stamp_ns)
        parts: list[MeasuredKeypoints] = []
        if tracks is not None:
            self.pair_clock.move(images.stamp_ns, *tracker.motion)
            if self._pace.is_pose_only(tracker, tracks, images.stamp_ns, camera, age_s):
                self.counters.add("frames_pose_only")
                return [pose_only(tracks, sigma)]
            stereo = self._stereo_depth.of_tracks(images, tracks)
            estimate = self._tof_depth.added_to(stereo, tracks.keypoints.uv, images, depth, T_left_tof)
            parts.append(followed(tracker, tracks, estimate, camera, sigma))
        number = parts[0].number_with_depth if parts else 0
        if tracker.needs_key_frame(number):
            self.pair_clock.move(images.stamp_ns, None, 0.0)
            self.counters.add("key_frames")
            left, estimate = self._detected(images, self._extract(images), depth, T_left_tof)
            parts.append(begun(tracker, number, images.left, left, estimate, camera, sigma))
        self._pace.mapped(images.stamp_ns, parts, age_s)
        return parts

    @property
    def self_calibration(self) -> StereoSelfCalibration:
        """The estimate of the rectification's error."""
        return self._stereo_depth.calibration

    @property
    def pair_clock(self) -> PairClock:
        """The estimate of the time between a pair's images."""
        return self._stereo_depth.clock

    def reset(self) -> None:
        """Forget everything since the start."""
        for part in (self._left, self._right, self._stereo_depth, self._tof_depth, self._tof):
            part.reset()
        if self._tracker is not None:
            self._tracker.reset()
        self._pace.reset()
        self.counters.counts.clear()

    @property
    def masked(self) -> int:
        """Keypoints left out so far because they lie in masks."""
        return self._left.masked + self._tof.masked

    def report(self) -> FrontendReport:
        """Findings about the images so far."""
        stereo, clock, device = self.self_calibration, self.pair_clock, self._device
        ranges = self._tof_depth.calibration
        said = (device.diagnostic, stereo.advice(), clock.advice(), ranges.advice(), self._tof.advice())
        return FrontendReport(
            rectification=stereo.figures() | clock.figures(),
            advice=tuple(filter(None, said)),
            picture="+".join(self._tof.used) if self.config.mode == "tof" else "stereo",
            correction=stereo.error if stereo.corrects else None,
            ranges=ranges.figures(),
            device=device.name,
            device_diagnostic=device.diagnostic,
            right_late_s=clock.finding,
        )

    def _described(self, images: StereoImages, left: Keypoints, needed: npt.NDArray[np.bool_]) -> Keypoints:
        """The left keypoints with descriptors for other moments: of those ``needed``, zeros for the others."""
        described = self._left.describe(images.left, left.select(needed)).descriptors
        descriptors = np.zeros((len(left), described.shape[1]), np.float32)
        descriptors[needed] = described
        return dataclasses.replace(left, descriptors=descriptors)
