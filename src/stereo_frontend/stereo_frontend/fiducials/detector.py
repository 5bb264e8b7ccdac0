# SPDX-License-Identifier: Apache-2.0
"""Tags in one grey image, by OpenCV's detector (Garrido-Jurado et al. 2014), AprilTags too (Olson 2011)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray
from slam_core.types import ByteArray

NONE = "none"
DICTIONARIES = {
    "apriltag_36h11": "DICT_APRILTAG_36h11",
    "apriltag_25h9": "DICT_APRILTAG_25h9",
    "apriltag_16h5": "DICT_APRILTAG_16h5",
    "aruco_4x4_50": "DICT_4X4_50",
    "aruco_4x4_250": "DICT_4X4_250",
    "aruco_5x5_250": "DICT_5X5_250",
    "aruco_6x6_250": "DICT_6X6_250",
    "aruco_7x7_250": "DICT_7X7_250",
    "aruco_original": "DICT_ARUCO_ORIGINAL",
}
"""OpenCV's name of each dictionary."""


@dataclass(frozen=True)
class TagConfig(Config):
    """Fiducial tags that are searched for."""

    dictionary: str = parameter(
        NONE, "fiducial tags that are searched for in the left image", choices=(NONE, *DICTIONARIES)
    )
    size: float = parameter(0.16, "edge of a tag's black square", unit="m", minimum=0.005, maximum=10.0)
    sigma: float = parameter(0.4, "standard deviation of a tag's corner", unit="px", minimum=0.05)
    min_edge: float = parameter(16.0, "shortest edge of a tag in the image", unit="px", minimum=8.0)

    @property
    def is_used(self) -> bool:
        """True if tags are searched for."""
        return self.dictionary != NONE


class TagDetector:
    """Finds the tags of one dictionary."""

    def __init__(self, config: TagConfig) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(dictionary_of(config.dictionary), parameters)
        self._min_edge = config.min_edge

    def __call__(self, image: ByteArray) -> dict[int, FloatArray]:
        """Corners (4, 2) px of the tags in an image, uint8 (height, width), by number.

        Without those that are small or that it shows twice: which of the two is meant, nothing can tell.
        """
        found, ids, _ = self._detector.detectMarkers(image)
        if ids is None:
            return {}
        numbers = [int(i) for i in np.ravel(ids)]
        corners = [np.asarray(c, dtype=np.float64).reshape(4, 2) for c in found]
        count = Counter(numbers)
        tags = {n: c for n, c in zip(numbers, corners, strict=True) if count[n] == 1 and _edge(c) >= self._min_edge}
        return {number: tags[number] for number in sorted(tags)}


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name of ours."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[name]))


def _edge(corners: FloatArray) -> float:
    """Length of the shortest edge, px."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
