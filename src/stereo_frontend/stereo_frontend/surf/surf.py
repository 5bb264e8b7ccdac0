# SPDX-License-Identifier: Apache-2.0
"""SURF, the thesis's choice of feature (ch. 3).

Bay, Ess, Tuytelaars, Van Gool: Speeded-Up Robust Features, CVIU 2008.

Extended descriptor (SURF-128) by default, SURF-64 on request. Oriented by default: on rigs that stay level the upright
one matches a sixth more, but where the camera rolls by 15 degrees and more it fails. On EuRoC's key frames, half of
whose motions roll, mapping lost 8 of 50 frames upright, 2 oriented, 2 with SIFT. The image is doubled by default, as
the paper proposes for accuracy: keypoints half the size, and half the error of their place.

Patents: SURF was covered by US 8,165,401 and EP 1 850 270 (Bay et al., filed 2006-2007). Whoever ships a product should
have their status checked; SIFT, whose patent US 6,711,293 ended in March 2020, is one configuration value away
(``detector: sift``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import ByteArray, Float32Array
from stereo_frontend.keypoints import MOST_KEYPOINTS, Keypoints, Selector
from stereo_frontend.surf.surf_descriptor import (
    DIMENSION,
    describe_oriented,
    describe_upright,
    merged_signs,
    region_weights,
)
from stereo_frontend.surf.surf_detector import MAX_PIXELS, find_keypoints, fitting_octaves, integral_image
from stereo_frontend.surf.surf_device import SurfDevice
from stereo_frontend.surf.surf_pair import PAIR_DIMENSION, SAMPLES, WEIGHT_SIGMA, describe_for_pair

_OCTAVES = 3
"""Octaves of four filter sizes."""
_CUSTOMARY_THRESHOLD = 26.0
"""Determinant of the Hessian of a customary keypoint, grey values 0 to 255."""

_DIAMETER = 9.0 / 1.2
"""Size of a keypoint (px) per unit of its scale: that of the filter that found it."""


_WEIGHTS, _PAIR_WEIGHTS = region_weights(), region_weights(SAMPLES, WEIGHT_SIGMA)


@dataclass(frozen=True)
class SurfConfig(Config):
    """Parameters of SURF, named as in the paper."""

    doubled: bool = True
    """Search the image enlarged twice: keypoints down to half the size."""
    upright: bool = parameter(False, "describe along the image axes (U-SURF) instead of the keypoint's orientation")
    extended: bool = parameter(True, "descriptors of 128 numbers (SURF-128) instead of 64: better told apart, slower")


class SurfDetector:
    """Finds and describes SURF keypoints; ``for_pairs``: only as well as matching within a stereo pair needs it."""

    def __init__(
        self, config: SurfConfig | None = None, *, for_pairs: bool = False, device: SurfDevice | None = None
    ) -> None:
        self.config, self.for_pairs = config or SurfConfig(), for_pairs
        self._device = device or SurfDevice()
        self._found = np.empty((MOST_KEYPOINTS, 4), np.float32)

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Keypoints above ``threshold`` times the configured one, thinned out by ``select`` before they are described.

        Raises
        ------
        ValueError
            If the image is too large for a 32-bit integral image.
        """
        if image.size > MAX_PIXELS:
            raise ValueError(f"SURF takes images of at most {MAX_PIXELS} px, got {image.shape[1]} x {image.shape[0]}")
        image = np.ascontiguousarray(image)
        found = self._find_all(image, threshold * _CUSTOMARY_THRESHOLD)
        found = found[select(found[:, :2], _DIAMETER * found[:, 2], found[:, 3])]
        places = found[:, :3].astype(np.float64)
        descriptors = self._describe_for_pair(image, places) if self.for_pairs else self._describe(image, places)
        return Keypoints(found[:, :2].copy(), _DIAMETER * found[:, 2], found[:, 3].copy(), descriptors)

    def describe(self, image: ByteArray, keypoints: Keypoints) -> Keypoints:
        """Keypoints of ``image`` with the descriptors that tell moments apart."""
        places = np.column_stack([keypoints.uv, keypoints.size / _DIAMETER]).astype(np.float64)
        return replace(keypoints, descriptors=self._describe(image, places))

    def _describe(self, image: ByteArray, places: FloatArray) -> Float32Array:
        upright = self.config.upright
        descriptors: Float32Array = self._device.compute(
            lambda surf: surf.describe(image, places, upright=upright),
            lambda: describe(image, places, upright=upright, extended=True),
        )
        return descriptors if self.config.extended else merged_signs(descriptors)

    def _describe_for_pair(self, image: ByteArray, places: FloatArray) -> Float32Array:
        descriptors: Float32Array = self._device.compute(
            lambda surf: surf.describe_for_pair(image, places), lambda: pair_descriptors(image, places)
        )
        return descriptors

    def _find_all(self, image: ByteArray, threshold: float) -> Float32Array:
        """Rows of u, v, scale, response, in pixels of ``image``."""
        doubled, pixel = self.config.doubled, 0.5 if self.config.doubled else 1.0
        height, width = (int(side / pixel) for side in image.shape)
        octaves = fitting_octaves(height, width, _OCTAVES)

        def on_cpu() -> Float32Array:
            number = find_keypoints(image, doubled, octaves, np.float32(threshold), self._found)
            return self._found[:number].copy()

        found: Float32Array = self._device.compute(
            lambda surf: surf.find(image, doubled=doubled, octaves=octaves, threshold=threshold), on_cpu
        )
        found[:, :2] = (found[:, :2] + 0.5) * pixel - 0.5
        found[:, 2] *= pixel
        return found


def describe(image: ByteArray, places: FloatArray, *, upright: bool, extended: bool) -> Float32Array:
    """Descriptors, (n, 128) or (n, 64) where not ``extended``, of places (n, 3): u, v and scale, px."""
    descriptors = np.empty((len(places), DIMENSION), np.float32)
    kernel = describe_upright if upright else describe_oriented
    kernel(integral_image(image), places, _WEIGHTS, descriptors)
    return descriptors if extended else merged_signs(descriptors)


def pair_descriptors(image: ByteArray, places: FloatArray) -> Float32Array:
    """Descriptors (n, 128) of the same places, for matching within a stereo pair."""
    descriptors = np.empty((len(places), PAIR_DIMENSION), np.float32)
    describe_for_pair(integral_image(image), places, _PAIR_WEIGHTS, descriptors)
    return descriptors
