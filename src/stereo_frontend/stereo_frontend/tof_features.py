"""Features of the ToF camera alone: found on its amplitude and range images, with depth from its own range (section
3.3).

The thesis finds range images best, amplitude useful, intensity unstable. Images are normalised, ``(I - min) / (max -
min)`` (Eq. 3.3), with the extremes taken as quantiles so that one glaring pixel does not darken the rest. The grey
image of an RGB-D camera serves as amplitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, group, parameter
from slam_core.types import ByteArray, DepthImage, Features, FeatureSource, Float32Array
from stereo_frontend.assembly import DepthEstimate, make_features
from stereo_frontend.depth_lookup import DepthLookupConfig, sample_depth
from stereo_frontend.features import FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.pixel_noise import PixelNoise, PixelNoiseConfig


@dataclass(frozen=True)
class TofFeatureConfig(Config):
    """Which images of the ToF camera give features."""

    images: str = parameter("amplitude", "images searched for features", choices=("amplitude", "range", "both"))
    clip: float = parameter(
        0.005, "share of pixels beyond the black and the white point each", minimum=0.0, maximum=0.2
    )
    gamma: float = parameter(0.5, "exponent after normalisation: lifts what is far and dark", minimum=0.1, maximum=2.0)
    lookup: DepthLookupConfig = group(DepthLookupConfig)


class TofFeatures:
    """Extracts features with depth from depth images of one camera."""

    def __init__(self, config: TofFeatureConfig, features: FeatureConfig, noise: PixelNoiseConfig) -> None:
        self.config = config
        self._amplitude = FeatureExtractor(features)
        self._range = FeatureExtractor(features)
        self._noise = PixelNoise(noise)

    def __call__(self, image: DepthImage, max_relative_sigma: float = 1.0) -> Features:
        """Features of ``image`` in the ToF optical frame; those without a single surface below them are left out."""
        keypoints = _joined([extractor(picture) for extractor, picture in self._pictures(image)])
        samples = sample_depth(image, keypoints.uv, self.config.lookup)
        sigma_uv = self._noise.sigma(keypoints.size)
        source = np.full(len(keypoints), FeatureSource.TOF, np.uint8)
        estimate = DepthEstimate(samples.depth, samples.sigma, source)
        return make_features(
            image.stamp_ns, keypoints, estimate, sigma_uv, image.camera, "tof_optical_frame", max_relative_sigma
        )

    def reset(self) -> None:
        """Forget the detector thresholds."""
        self._amplitude.reset()
        self._range.reset()

    def _pictures(self, image: DepthImage) -> list[tuple[FeatureExtractor, ByteArray]]:
        pictures = []
        if image.amplitude is not None and self.config.images != "range":
            pictures.append((self._amplitude, normalised_picture(image.amplitude, self.config.clip, self.config.gamma)))
        if not pictures or self.config.images != "amplitude":
            pictures.append((self._range, normalised_picture(image.depth, self.config.clip, 1.0)))
        return pictures


def normalised_picture(values: Float32Array, clip: float, gamma: float) -> ByteArray:
    """An 8-bit picture of amplitude or range (Eq. 3.3); missing values are white, an image without contrast black."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return np.zeros(values.shape, np.uint8)
    low, high = np.quantile(finite[:: max(1, finite.size // 20000)], [clip, 1.0 - clip])
    if not high > low:
        return np.zeros(values.shape, np.uint8)
    unit = np.clip((values - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return np.asarray(255.0 * np.nan_to_num(unit, nan=1.0) ** np.float32(gamma) + 0.5).astype(np.uint8)


def _joined(parts: list[Keypoints]) -> Keypoints:
    fields = ("uv", "size", "response", "descriptors")
    filled = [p for p in parts if len(p)] or parts[:1]
    return Keypoints(*(np.concatenate([getattr(p, f) for p in filled]) for f in fields))
