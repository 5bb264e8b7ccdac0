# SPDX-License-Identifier: Apache-2.0
"""CenSurE keypoints (Agrawal, Konolige and Blas 2008), which OpenCV calls Star, described as SURF-128.

OpenCV has the detector only; the authors describe its keypoints with a modified upright SURF.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slam_core.types import ByteArray
from stereo_frontend.keypoints import Keypoints, Selector
from stereo_frontend.opencv_detectors import create_from_opencv
from stereo_frontend.surf_descriptor import DIMENSION, describe_upright, region_weights
from stereo_frontend.surf_detector import integral_image

_RESPONSE = 15.0
"""Customary response threshold on grey values 0 to 255."""
_SCALE_PER_SIZE = 1.2 / 9.0


class StarDetector:
    """Finds CenSurE keypoints and describes them; ValueError if the installed OpenCV lacks the detector."""

    def __init__(self) -> None:
        self._weights = region_weights()
        self._create(1.0)

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Keypoints above ``threshold`` times the customary one, thinned out by ``select``."""
        found = self._create(threshold).detect(image, None)
        if not found:
            return Keypoints.none()
        uv = np.array([k.pt for k in found], np.float32)
        size = np.array([k.size for k in found], np.float32)
        response = np.abs(np.array([k.response for k in found], np.float32))
        kept = select(uv, size, response)
        descriptors = np.empty((len(kept), DIMENSION), np.float32)
        places = np.column_stack([uv[kept], _SCALE_PER_SIZE * size[kept]]).astype(np.float64)
        describe_upright(integral_image(np.ascontiguousarray(image)), places, self._weights, descriptors)
        return Keypoints(uv[kept], size[kept], response[kept], descriptors)

    def _create(self, threshold: float) -> Any:
        # maxSize, responseThreshold, lineThresholdProjected, lineThresholdBinarized, suppressNonmaxSize
        return create_from_opencv("StarDetector", 45, max(1, round(_RESPONSE * threshold)), 10, 8, 5)
