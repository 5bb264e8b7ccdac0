# SPDX-License-Identifier: Apache-2.0
"""OpenCV's FAST corners (Rosten and Drummond 2006), described as SURF.

A corner is a pixel with nine neighbouring ones on the circle around it that all are brighter, or all darker. It has no
scale of its own, so all are described at one.
"""

from __future__ import annotations

import cv2
import numpy as np

from slam_core.types import ByteArray
from stereo_frontend.detection.opencv_detectors import FAST_THRESHOLD
from stereo_frontend.keypoints import DescribesAtOnce, Keypoints, Selector
from stereo_frontend.surf.surf import SurfConfig, describe

_SCALE = 2.0
"""Scale of the description, px: 40 px are described about a corner."""
_DIAMETER = 7.0
"""Diameter of the circle, px."""
_LEAST, _MOST = 2, 120
"""Thresholds, grey values, between which FAST is asked for corners."""


class FastDetector(DescribesAtOnce):
    """Finds FAST corners and describes them as ``surf`` says."""

    def __init__(self, surf: SurfConfig | None = None) -> None:
        self._surf = surf or SurfConfig()

    def __call__(self, image: ByteArray, threshold: float, select: Selector) -> Keypoints:
        """Corners above ``threshold`` times the customary one, thinned out by ``select``."""
        least = int(np.clip(round(FAST_THRESHOLD * threshold), _LEAST, _MOST))
        found = cv2.FastFeatureDetector.create(least).detect(image, None)
        uv = np.asarray(cv2.KeyPoint.convert(found), np.float32).reshape(-1, 2)
        size = np.full(len(uv), _DIAMETER, np.float32)
        response = np.array([corner.response for corner in found], np.float32)
        kept = select(uv, size, response)
        places = np.column_stack([uv[kept], np.full(len(kept), _SCALE)]).astype(np.float64)
        descriptors = describe(image, places, upright=self._surf.upright, extended=self._surf.extended)
        return Keypoints(uv[kept], size[kept], response[kept], descriptors)
