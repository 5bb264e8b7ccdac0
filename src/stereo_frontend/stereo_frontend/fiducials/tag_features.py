# SPDX-License-Identifier: Apache-2.0
"""Tags as features: their corners with depth from the tag's pose, after those of the front end.

Four corners share the error of one pose. Each goes out with twice its own sigma of depth: four times the diagonal of a
covariance of four blocks is never less than the covariance itself, whatever the blocks' correlation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from slam_core.camera import Camera, StereoCamera
from slam_core.geometry import FloatArray
from slam_core.tags import CORNERS, corner_ids
from slam_core.types import ByteArray, Counters, DepthImage, Features, FeatureSource, StereoImages
from stereo_frontend.depth.depth_lookup import sample_depth
from stereo_frontend.fiducials.detector import TagConfig, TagDetector
from stereo_frontend.fiducials.tag_pose import TagPose, TagView, estimate_tag_pose
from stereo_frontend.stereo.pair_clock import PairClock
from stereo_frontend.stereo.self_calibration import StereoSelfCalibration

_SHARED = 2.0
"""Factor on sigma of depth of each corner; see the module."""
_INNER = (0.3, 0.5, 0.7)
"""Places at which depth is read on a tag, in shares of its edges."""
_RATIOS_KEPT = 20
_RATIOS_NEEDED = 6
_WRONG_SIZE = 0.08
"""Difference of the size that stereo measures from the one that is configured, of which the user is told."""
_RECTIFICATION_SIGMA = 0.15
"""Error of the rectification beyond what self-calibration knows, px."""


@dataclass(frozen=True, eq=False)
class SeenTag:
    """A tag in an image: its corners (4, 2) px and its pose in the optical frame."""

    number: int
    corners: FloatArray
    pose: TagPose


class TagFeatures:
    """Finds tags and adds them to features; ``counters`` says what was found and refused."""

    def __init__(self, config: TagConfig) -> None:
        self.config = config
        self.counters = Counters()
        self._detect = TagDetector(config)
        self._ratios: deque[float] = deque(maxlen=_RATIOS_KEPT)

    def with_tags(self, features: Features, tags: list[SeenTag]) -> Features:
        """The features and the corners of tags."""
        if not tags:
            return features
        return features.joined(self._features(features, tags))

    def of_pair(self, images: StereoImages, calibration: StereoSelfCalibration, clock: PairClock) -> list[SeenTag]:
        """The tags of the left image; by both images where the right one shows them too.

        Corrected for what ``calibration`` and ``clock`` know of the rectification and of the time between the images.
        """
        left = self._detect(images.left)
        right = self._detect(images.right) if left else {}
        views = {n: self._pair_view(images.stereo, c, right.get(n), calibration, clock) for n, c in left.items()}
        return self._fitting(views)

    def of_depth(self, image: DepthImage, picture: ByteArray) -> list[SeenTag]:
        """The tags of a depth camera's picture, with the depth on them."""
        found = self._detect(picture)
        return self._fitting({n: self._depth_view(image, corners) for n, corners in found.items()})

    @property
    def advice(self) -> str:
        """Complaint about the size that is configured, or ""."""
        if len(self._ratios) < _RATIOS_NEEDED:
            return ""
        ratio = float(np.median(self._ratios))
        if abs(ratio - 1.0) <= _WRONG_SIZE:
            return ""
        return f"tags are {ratio * self.config.size:.3f} m wide as measured, tags.size says {self.config.size:g} m"

    def _fitting(self, views: Mapping[int, TagView]) -> list[SeenTag]:
        out = []
        for number, view in views.items():
            pose = estimate_tag_pose(view, self.config.size)
            if pose is None or not pose.fits:
                self.counters.add("tags_that_do_not_fit")
                continue
            self.counters.add("tags_seen")
            if pose.is_ambiguous:
                self.counters.add("tags_ambiguous")
            out.append(SeenTag(number, view.left, pose))
        return out

    def _pair_view(
        self,
        stereo: StereoCamera,
        left: FloatArray,
        right: FloatArray | None,
        calibration: StereoSelfCalibration,
        clock: PairClock,
    ) -> TagView:
        view = TagView(stereo.camera, left, self.config.sigma)
        if right is None or not np.all(left[:, 0] > right[:, 0]):
            return view
        late = clock.shift(stereo, right, left[:, 0] - right[:, 0])
        right = right - late.uv
        as_seen = right.astype(np.float32)
        correction, sigma = calibration.columns(as_seen)
        rows = calibration.rows(as_seen, left[:, 0] - right[:, 0])
        partner = right + np.column_stack([-correction, rows])
        self._learn_size(stereo.camera, left, stereo.depth_from_disparity(left[:, 0] - partner[:, 0]))
        spread = np.sqrt(self.config.sigma**2 + sigma**2 + late.sigma**2 + _RECTIFICATION_SIGMA**2)
        return replace(view, right=partner, right_sigma=spread, baseline=stereo.baseline)

    def _depth_view(self, image: DepthImage, corners: FloatArray) -> TagView:
        view = TagView(image.camera, corners, self.config.sigma)
        a, b, c, d = corners
        pixels = np.array([(1 - s) * ((1 - r) * a + r * b) + s * ((1 - r) * d + r * c) for r in _INNER for s in _INNER])
        samples = sample_depth(image, pixels)
        good = np.isfinite(samples.depth) & (samples.sigma > 0.0)
        if good.sum() < len(_INNER):
            return view
        # Errors of range are the same all over so small a surface: the samples count as one.
        sigma = np.sqrt(good.sum()) * samples.sigma[good]
        rays = image.camera.normalised_from_pixels(pixels[good])
        self._learn_size(image.camera, corners, np.full(CORNERS, np.median(samples.depth[good])))
        return replace(view, rays=rays, depth=samples.depth[good], depth_sigma=sigma)

    def _learn_size(self, camera: Camera, corners: FloatArray, depth: FloatArray) -> None:
        """Size that the depths tell, as a share of the one that is configured."""
        points = camera.unproject(corners, depth)
        edges = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        self._ratios.append(float(np.median(edges)) / self.config.size)

    def _features(self, others: Features, tags: list[SeenTag]) -> Features:
        n = CORNERS * len(tags)
        uv = np.concatenate([t.corners for t in tags])
        depth = np.concatenate([t.pose.depth for t in tags])
        sigma = np.concatenate([t.pose.sigma for t in tags])
        return Features(
            stamp_ns=others.stamp_ns,
            xyz=others.camera.unproject(uv, depth).astype(np.float32),
            uv=uv.astype(np.float32),
            depth=depth.astype(np.float32),
            sigma_uv=np.full((n, 2), self.config.sigma, np.float32),
            sigma_depth=(_SHARED * sigma).astype(np.float32),
            response=np.ones(n, np.float32),
            source=np.full(n, FeatureSource.TAG, np.uint8),
            descriptors=np.zeros((n, others.descriptors.shape[1]), np.float32),
            camera=others.camera,
            frame_id=others.frame_id,
            track_ids=corner_ids([t.number for t in tags]).astype(np.int32),
        )
