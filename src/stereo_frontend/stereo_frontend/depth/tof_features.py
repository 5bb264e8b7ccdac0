# SPDX-License-Identifier: Apache-2.0
"""Features of the ToF camera alone: found on one of its images, with depth from its own range (section 3.3).

Amplitude first: it is lit by the camera itself. Intensity, or the grey image of an RGB-D camera under either name,
where there is no amplitude or it is blank. The range image only where there is nothing else: a smooth wall has no
texture in it, and edges of depth move with the view. Images are normalised, ``(I - min) / (max - min)`` (Eq. 3.3), with
the extremes taken as quantiles so that one glaring pixel does not darken the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_core.config import Config, parameter
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, DepthImage, Features, FeatureSource, Float32Array
from stereo_frontend.assembly import DepthEstimate, MeasuredKeypoints, joined_features
from stereo_frontend.depth.depth_lookup import has_depth, sample_depth
from stereo_frontend.detection.features import FeatureConfig, FeatureExtractor
from stereo_frontend.keypoints import Keypoints
from stereo_frontend.stereo.pixel_noise import PixelNoise, PixelNoiseConfig
from stereo_frontend.surf.surf_device import SurfDevice
from stereo_frontend.tracking.mapping_pace import MappingPace
from stereo_frontend.tracking.tracked_features import PREDICTED_SIGMA, begun, followed, pose_only
from stereo_frontend.tracking.tracker import Tracker

CLIP = 0.005
"""Share of pixels beyond the black and the white point each."""
GAMMA = 0.5
"""Exponent after normalisation: lifts what is far and dark."""
TOF_LONGEST_STEP_S = 0.15
"""Time between images beyond which nothing is followed: half of a stereo camera's. At 5 Hz a head-mounted depth camera
loses so many tracks in a turn that frames stay without a pose.
"""


@dataclass(frozen=True)
class TofFeatureConfig(Config):
    """Images of the ToF camera that give features."""

    images: str = parameter(
        "auto",
        "image searched for features; auto: amplitude, where there is none intensity, where there is neither range; "
        "both: amplitude and range",
        choices=("auto", "amplitude", "intensity", "range", "both"),
    )


class TofFeatures:
    """Extracts features with depth from depth images of one camera, by a tracker where there is one."""

    def __init__(
        self,
        config: TofFeatureConfig,
        features: FeatureConfig,
        noise: PixelNoiseConfig,
        tracker: Tracker | None,
        pace: MappingPace,
        device: SurfDevice | None = None,
    ) -> None:
        self.config = config
        names = ("amplitude", "intensity", "range")
        self._extractors = {name: FeatureExtractor(features, device=device) for name in names}
        self._noise = PixelNoise(noise)
        self._tracker, self._pace = tracker, pace
        self.used: tuple[str, ...] = ()
        """Names of the images that the newest features come from."""

    def __call__(self, image: DepthImage, max_relative_sigma: float = 1.0) -> Features:
        """Features of ``image`` in the ToF optical frame; those without a single surface below them are left out."""
        before, pictures = self.used, self._pictures(image)
        if self._tracker is None or len(pictures) > 1:
            keypoints = _joined([self._with_depth(image, name, picture) for name, picture in pictures.items()])
            parts = [
                MeasuredKeypoints.untracked(keypoints, _depth_at(image, keypoints), self._noise.sigma(keypoints.size))
            ]
        else:
            if self.used != before:
                self._tracker.forget()
            parts = self._tracked(self._tracker, image, *pictures.popitem())
        return joined_features(parts, image.stamp_ns, image.camera, "tof_optical_frame", max_relative_sigma)

    def _with_depth(self, image: DepthImage, name: str, picture: ByteArray) -> Keypoints:
        """Keypoints in the picture of that name; those without a depth, which no one uses, are not described."""
        return self._extractors[name](picture, image.mask, lambda uv: has_depth(image, uv))

    def _tracked(self, tracker: Tracker, image: DepthImage, name: str, picture: ByteArray) -> list[MeasuredKeypoints]:
        """Tracks in the picture of that name, and in a frame that maps new keypoints where they are few.

        Of tracks without a measured depth the direction counts, with the depth that the motion predicts.
        """
        parts, sigma = [], self._noise.sigma
        tracks = tracker.follow(picture, image.camera, image.stamp_ns, image.mask)
        if tracks is not None and self._pace.is_pose_only(tracker, tracks, image.stamp_ns, image.camera):
            return [pose_only(tracks, sigma)]
        if tracks is not None:
            estimate = _depth_at(image, tracks.keypoints).completed(tracks.depth, PREDICTED_SIGMA)
            parts.append(followed(tracker, tracks, estimate, image.camera, sigma))
        number = parts[0].number_with_depth if parts else 0
        if tracker.needs_key_frame(number):
            keypoints = self._extractors[name](picture, image.mask)
            estimate = _depth_at(image, keypoints)
            parts.append(begun(tracker, number, picture, keypoints, estimate, image.camera, sigma))
        self._pace.mapped(image.stamp_ns, parts)
        return parts

    @property
    def masked(self) -> int:
        """Keypoints left out so far because they lie in masks."""
        return sum(extractor.masked for extractor in self._extractors.values())

    def reset(self) -> None:
        """Forget the detector thresholds."""
        for extractor in self._extractors.values():
            extractor.reset()
        self.used = ()

    def advice(self) -> str:
        """Advice to the user about the images used, or ""."""
        if self.used != ("range",) or self.config.images == "range":
            return ""
        return (
            "features come from range images, which show little: record tof/amplitude/image_raw, "
            "tof/intensity/image_raw or the depth camera's grey image under one of these names"
        )

    def _pictures(self, image: DepthImage) -> dict[str, ByteArray]:
        self.used = self._choose(image)
        return {name: self.picture(image, name) for name in self.used}

    def _choose(self, image: DepthImage) -> tuple[str, ...]:
        wanted = self.config.images
        order = ("amplitude", "intensity") if wanted in ("auto", "both") else (wanted,)
        grey = next((name for name in order if _shows_something(_values(image, name))), None)
        if grey is None:
            return ("range",)
        return (grey, "range") if wanted == "both" else (grey,)

    def picture(self, image: DepthImage, name: str) -> ByteArray:
        """The 8-bit picture of that name in which features are searched."""
        values = _values(image, name)
        assert values is not None
        return normalised_picture(values, CLIP, 1.0 if name == "range" else GAMMA)


def _depth_at(image: DepthImage, keypoints: Keypoints) -> DepthEstimate:
    samples = sample_depth(image, keypoints.uv)
    return DepthEstimate(samples.depth, samples.sigma, np.full(len(keypoints), FeatureSource.TOF, np.uint8))


def _values(image: DepthImage, name: str) -> Float32Array | None:
    return {"amplitude": image.amplitude, "intensity": image.intensity, "range": image.depth}[name]


def _shows_something(values: Float32Array | None) -> bool:
    """True if there is a picture that is not blank."""
    return values is not None and bool(np.nanmax(values, initial=-np.inf) > np.nanmin(values, initial=np.inf))


def normalised_picture(values: Float32Array, clip: float, gamma: float) -> ByteArray:
    """An 8-bit picture of an image (Eq. 3.3); missing values are white, an image without contrast black."""
    known = np.isfinite(values)
    finite = values.ravel() if known.all() else values[known]
    if finite.size == 0:
        return np.zeros(values.shape, np.uint8)
    low, high = np.quantile(finite[:: max(1, finite.size // 20000)], [clip, 1.0 - clip])
    if not high > low:
        return np.zeros(values.shape, np.uint8)
    picture = np.empty(values.shape, np.uint8)
    flat, span = np.asarray(values, np.float32).ravel(), np.float32(high - low)
    if gamma == 0.5:
        _to_lifted_grey(flat, np.float32(low), span, picture.reshape(-1))
    else:
        unit = np.empty(values.size, np.float32)
        _normalise(flat, np.float32(low), span, unit)
        _to_grey(unit ** np.float32(gamma), picture.reshape(-1))
    return picture


@in_place(error_model="numpy")
def _to_lifted_grey(values, low, span, out):  # type: ignore[no-untyped-def]
    """Do at once what :func:`_normalise`, the square root and :func:`_to_grey` do one after the other."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(len(values)):
        share = (values[i] - low) / span
        unit = max(share, zero) if share < one else one
        out[i] = np.uint8(np.int32(np.float32(255.0) * np.sqrt(unit) + np.float32(0.5)))


@in_place(error_model="numpy")
def _normalise(values, low, span, out):  # type: ignore[no-untyped-def]
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(len(values)):
        share = (values[i] - low) / span
        out[i] = max(share, zero) if share < one else one  # a missing value is no less than one


@in_place()
def _to_grey(unit, out):  # type: ignore[no-untyped-def]
    for i in range(len(unit)):
        out[i] = np.uint8(np.int32(np.float32(255.0) * unit[i] + np.float32(0.5)))


def _joined(parts: list[Keypoints]) -> Keypoints:
    fields = ("uv", "size", "response", "descriptors")
    filled = [p for p in parts if len(p)] or parts[:1]
    return Keypoints(*(np.concatenate([getattr(p, f) for p in filled]) for f in fields))
