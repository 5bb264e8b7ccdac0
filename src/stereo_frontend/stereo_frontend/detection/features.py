# SPDX-License-Identifier: Apache-2.0
"""Features of one image: keypoints spread over a grid, with unit-norm descriptors, behind one interface.

Every detector runs the same way: it returns all keypoints above a threshold; a grid keeps the strongest of each cell,
so that features cover the image (thesis section 3.2); the threshold follows the number found from frame to frame
(thesis ch. 9), so that a second pass over the image is the exception. Detectors: ``surf``
(:mod:`stereo_frontend.surf.surf`), ``censure`` (:mod:`stereo_frontend.detection.censure`), ``fast``
(:mod:`stereo_frontend.detection.fast`), and ``sift``, ``rootsift``, ``orb`` from OpenCV
(:mod:`stereo_frontend.detection.opencv_detectors`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.config import Config, group, parameter
from slam_core.types import ByteArray, Float32Array
from stereo_frontend.detection.censure import CensureDetector
from stereo_frontend.detection.fast import FastDetector
from stereo_frontend.detection.opencv_detectors import OpenCvDetector
from stereo_frontend.keypoints import Detector, Keypoints, spread_over_grid
from stereo_frontend.masks import is_masked
from stereo_frontend.surf.surf import SurfConfig, SurfDetector
from stereo_frontend.surf.surf_device import CPU, SurfDevice

_GRID_COLUMNS = 10
"""Columns of the coverage grid."""
_GRID_ROWS = 8
"""Rows of the coverage grid."""
_SURPLUS = 1.5
"""Candidates wanted per feature kept: the grid chooses among them."""
_ADAPTATION = 0.7
"""Rate at which the threshold follows the number of candidates; 0 keeps it fixed."""

Places = Callable[[Float32Array], npt.NDArray[np.bool_]]
"""Tells of places (n, 2) px whether they are wanted (n,)."""

TRACKING = ("auto", "always", "never")
"""Words that YAML does not take for true and false."""
DETECTORS = ("surf", "sift", "rootsift", "orb", "censure", "fast")
_THRESHOLD_RANGE = (0.02, 20.0)
_FIRST_THRESHOLD = 0.3
"""Of the customary one: the first image rather gives too many candidates than too few."""
_MOST_PASSES = 3


@dataclass(frozen=True)
class FeatureConfig(Config):
    """Detector, number and spread of the features."""

    detector: str = parameter("surf", "keypoint detector and descriptor", choices=DETECTORS)
    target: int = parameter(600, "number of features wanted per image", minimum=10, maximum=20000)
    tracking: str = parameter(
        "auto",
        "follow features from frame to frame by their patches, and detect new ones only where these are few; "
        "auto: in all modes but tof",
        choices=TRACKING,
    )
    device: str = parameter(
        "cpu",
        "where SURF is computed: cpu; gpu, the first one that OpenCL knows; auto, the same if there is one; or a part "
        "of the name of any OpenCL device (needs pyopencl)",
    )
    mapping_interval: float = parameter(
        0.1,
        "time within which a frame whose features were all followed tells the pose alone: nothing is detected in it, "
        "and no depth is measured; 0: every frame maps",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    )
    max_tracks: int = parameter(150, "most features followed at a time", minimum=20, maximum=2000)
    surf: SurfConfig = group(SurfConfig)

    def open_device(self) -> SurfDevice:
        """The device that SURF asks for; the CPU for other detectors."""
        return SurfDevice(self.device if self.detector == "surf" else CPU)


def make_detector(config: FeatureConfig, *, for_pairs: bool = False, device: SurfDevice | None = None) -> Detector:
    """The configured detector; ``for_pairs``: its descriptors need do for matching within a stereo pair only.

    ``device``: one that is open already and shared.
    """
    if config.detector == "surf":
        return SurfDetector(config.surf, for_pairs=for_pairs, device=device or config.open_device())
    if config.detector == "fast":
        return FastDetector(config.surf)
    return CensureDetector(config.surf) if config.detector == "censure" else OpenCvDetector(config.detector)


class FeatureExtractor:
    """Extracts features from the images of one camera, remembering the detector threshold from frame to frame.

    The state is that one number, so equal images give equal features however they arrive.
    """

    def __init__(
        self, config: FeatureConfig | None = None, *, for_pairs: bool = False, device: SurfDevice | None = None
    ) -> None:
        self.config = config or FeatureConfig()
        self.threshold = _FIRST_THRESHOLD
        self.masked = 0
        """Keypoints left out so far because they lie in masks."""
        self._detect = make_detector(self.config, for_pairs=for_pairs, device=device)

    def __call__(self, image: ByteArray, mask: ByteArray | None = None, is_wanted: Places | None = None) -> Keypoints:
        """At most ``target`` keypoints of an image, uint8 (height, width), best of each grid cell first.

        None lies where ``mask``, of the same shape, is not zero. Of those chosen only the ones whose places (n, 2) px
        ``is_wanted`` says True (n,) of are described and returned.

        Raises
        ------
        ValueError
            If the image is not uint8 grey.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"features need a uint8 grey image (height, width), got {image.dtype} {image.shape}")
        for _ in range(_MOST_PASSES):
            keypoints, candidates = self._one_pass(image, mask, is_wanted)
            enough = candidates >= self.config.target or self.threshold <= _THRESHOLD_RANGE[0]
            self._adapt(candidates)
            if enough or _ADAPTATION == 0.0:
                break
        return keypoints

    def describe(self, image: ByteArray, keypoints: Keypoints) -> Keypoints:
        """Keypoints found in ``image`` with the descriptors that other moments are compared by."""
        return self._detect.describe(image, keypoints)

    def reset(self) -> None:
        """Forget the threshold."""
        self.threshold = _FIRST_THRESHOLD

    def _one_pass(self, image: ByteArray, mask: ByteArray | None, is_wanted: Places | None) -> tuple[Keypoints, int]:
        candidates = masked = 0

        def select(uv: Float32Array, size: Float32Array, response: Float32Array) -> npt.NDArray[np.intp]:
            nonlocal candidates, masked
            free = np.flatnonzero(~is_masked(mask, uv))
            candidates, masked = len(free), len(uv) - len(free)
            shape, grid = (image.shape[0], image.shape[1]), (_GRID_ROWS, _GRID_COLUMNS)
            chosen = free[spread_over_grid(uv[free], response[free], shape, grid, self.config.target)]
            return chosen if is_wanted is None else chosen[is_wanted(uv[chosen])]

        keypoints = self._detect(image, self.threshold, select)
        self.masked += masked
        return keypoints, candidates

    def _adapt(self, candidates: int) -> None:
        """Move the threshold so that the next image gives ``surplus * target`` candidates.

        Their number falls as 1/threshold.
        """
        ratio = np.clip(candidates / (_SURPLUS * self.config.target), 0.25, 4.0)
        self.threshold = float(np.clip(self.threshold * ratio**_ADAPTATION, *_THRESHOLD_RANGE))
