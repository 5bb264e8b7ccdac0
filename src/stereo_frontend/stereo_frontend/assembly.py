# SPDX-License-Identifier: Apache-2.0
"""Keypoints plus depth become :class:`slam_core.types.Features`."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera
from slam_core.geometry import FloatArray
from slam_core.types import ByteArray, Features, FeatureSource, Float32Array
from stereo_frontend.keypoints import Keypoints


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """Depth of keypoints: depth (n,) m along z, NaN where unknown.

    Sigma (n,) m; source (n,), see :class:`FeatureSource`.
    """

    depth: FloatArray
    sigma: FloatArray
    source: ByteArray

    def select(self, index: npt.NDArray[np.intp]) -> DepthEstimate:
        """The estimates at ``index``."""
        return DepthEstimate(self.depth[index], self.sigma[index], self.source[index])

    def completed(self, predicted: FloatArray, relative_sigma: float) -> DepthEstimate:
        """With predicted depths (n,) m where none is known, of a standard deviation given as a share of them."""
        missing = ~np.isfinite(self.depth)
        sigma = np.where(missing, relative_sigma * predicted, self.sigma)
        source = np.where(missing, np.uint8(FeatureSource.PREDICTED), self.source)
        return DepthEstimate(np.where(missing, predicted, self.depth), sigma, source)

    @staticmethod
    def unknown(n: int) -> DepthEstimate:
        """No depth for any of ``n`` keypoints."""
        return DepthEstimate(np.full(n, np.nan), np.full(n, np.nan), np.full(n, FeatureSource.STEREO, np.uint8))


@dataclass(frozen=True, eq=False)
class MeasuredKeypoints:
    """Keypoints (n) with their depth, sigma_uv (n, 2) px, and track_ids (n,), 0 of those that are not followed."""

    keypoints: Keypoints
    estimate: DepthEstimate
    sigma_uv: Float32Array
    track_ids: npt.NDArray[np.int32]

    @staticmethod
    def untracked(keypoints: Keypoints, estimate: DepthEstimate, sigma: Float32Array) -> MeasuredKeypoints:
        """Keypoints (n) of one picture alone, with the standard deviation (n,) px of either coordinate."""
        return MeasuredKeypoints(
            keypoints, estimate, np.repeat(sigma[:, None], 2, axis=1), np.zeros(len(keypoints), np.int32)
        )

    @property
    def number_with_depth(self) -> int:
        """Number of keypoints with a known depth."""
        return int(np.isfinite(self.estimate.depth).sum())

    def features(self, stamp_ns: int, camera: Camera, frame_id: str, max_relative_sigma: float) -> Features:
        """The keypoints with a positive depth known to better than ``max_relative_sigma`` of itself, in their order."""
        depth, sigma = self.estimate.depth, self.estimate.sigma
        known = np.isfinite(depth) & np.isfinite(sigma) & (depth > 0.0)
        keep = np.flatnonzero(known & (np.nan_to_num(sigma) <= max_relative_sigma * np.nan_to_num(depth)))
        uv = self.keypoints.uv[keep]
        return Features(
            stamp_ns=stamp_ns,
            xyz=camera.unproject(uv.astype(np.float64), depth[keep]).astype(np.float32),
            uv=uv,
            depth=depth[keep].astype(np.float32),
            sigma_uv=self.sigma_uv[keep].astype(np.float32),
            sigma_depth=sigma[keep].astype(np.float32),
            response=self.keypoints.response[keep],
            source=self.estimate.source[keep],
            descriptors=self.keypoints.descriptors[keep],
            camera=camera,
            frame_id=frame_id,
            track_ids=self.track_ids[keep],
        )


def joined_features(
    parts: Sequence[MeasuredKeypoints], stamp_ns: int, camera: Camera, frame_id: str, max_relative_sigma: float
) -> Features:
    """Features of one frame from all ``parts`` of its keypoints; see :meth:`MeasuredKeypoints.features`."""
    features = [part.features(stamp_ns, camera, frame_id, max_relative_sigma) for part in parts]
    return functools.reduce(Features.joined, features)
