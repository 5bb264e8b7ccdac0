# SPDX-License-Identifier: Apache-2.0
"""Parameters of the front end, and what it reports of its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slam_core.config import Config, group, parameter
from stereo_frontend.depth.depth_fusion import FusionConfig
from stereo_frontend.depth.range_self_calibration import RangeSelfCalibrationConfig
from stereo_frontend.depth.tof_features import TofFeatureConfig
from stereo_frontend.detection.features import FeatureConfig
from stereo_frontend.fiducials.detector import TagConfig
from stereo_frontend.masks import MaskingConfig
from stereo_frontend.stereo.disparity import DisparityConfig
from stereo_frontend.stereo.matching import MatchingConfig
from stereo_frontend.stereo.pair_clock import PairClockConfig
from stereo_frontend.stereo.pixel_noise import PixelNoiseConfig
from stereo_frontend.stereo.rectification_error import RectificationError
from stereo_frontend.stereo.self_calibration import SelfCalibrationConfig
from stereo_frontend.surf.surf_device import CPU

MODES = ("stereo", "tof", "replace", "fuse")
_TRACKED = ("stereo", "replace", "fuse")
"""Modes in which features are followed by default."""


@dataclass(frozen=True)
class FrontendConfig(Config):
    """Everything between rectified images and features."""

    mode: str = parameter("stereo", "where depth comes from", choices=MODES)
    features: FeatureConfig = group(FeatureConfig)
    matching: MatchingConfig = group(MatchingConfig)
    disparity: DisparityConfig = group(DisparityConfig)
    noise: PixelNoiseConfig = group(PixelNoiseConfig)
    self_calibration: SelfCalibrationConfig = group(SelfCalibrationConfig)
    pair: PairClockConfig = group(PairClockConfig)
    fusion: FusionConfig = group(FusionConfig)
    range_calibration: RangeSelfCalibrationConfig = group(RangeSelfCalibrationConfig)
    tof: TofFeatureConfig = group(TofFeatureConfig)
    mask: MaskingConfig = group(MaskingConfig)
    tags: TagConfig = group(TagConfig)

    @property
    def tracks(self) -> bool:
        """True if features are followed: where asked for, and by itself in the modes in which maps gain by it."""
        wanted = self.features.tracking
        return wanted == "always" or (wanted == "auto" and self.mode in _TRACKED)


@dataclass(frozen=True)
class FrontendReport:
    """Findings of the front end about its images.

    rectification: figures of the stereo pair and of the time between its images; ranges: of the depth camera beside it;
    advice: to the user, a sentence each; picture: what features are searched in: "stereo", "amplitude", "intensity",
    "range" or "" before the first image; correction: what the right image's rectification is wrong by, where
    disparities are corrected for it; device: where SURF is computed; device_diagnostic: why not where it was asked for,
    or "", also one of ``advice``; right_late_s: time of the right image after the left one and its standard deviation,
    zeros where none is seen.
    """

    rectification: Mapping[str, float | str] = field(default_factory=dict)
    advice: tuple[str, ...] = ()
    picture: str = ""
    correction: RectificationError | None = None
    ranges: Mapping[str, float | str] = field(default_factory=dict)
    device: str = CPU
    device_diagnostic: str = ""
    right_late_s: tuple[float, float] = (0.0, 0.0)
