# SPDX-License-Identifier: Apache-2.0
"""Keypoints plus depth become :class:`slam_core.types.Features`."""

from __future__ import annotations

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
        return DepthEstimate(np.where(missing, predicted, self.depth), sigma, self.source)

    @staticmethod
    def unknown(n: int) -> DepthEstimate:
        """No depth for any of ``n`` keypoints."""
        return DepthEstimate(np.full(n, np.nan), np.full(n, np.nan), np.full(n, FeatureSource.STEREO, np.uint8))


def make_features(
    stamp_ns: int,
    keypoints: Keypoints,
    estimate: DepthEstimate,
    sigma_uv: Float32Array,
    camera: Camera,
    frame_id: str,
    max_relative_sigma: float,
    track_ids: npt.NDArray[np.int32] | None = None,
) -> Features:
    """The keypoints with a positive depth known to better than ``max_relative_sigma`` of itself, in their order."""
    known = np.isfinite(estimate.depth) & np.isfinite(estimate.sigma) & (estimate.depth > 0.0)
    keep = np.flatnonzero(known & (np.nan_to_num(estimate.sigma) <= max_relative_sigma * np.nan_to_num(estimate.depth)))
    uv, depth = keypoints.uv[keep], estimate.depth[keep]
    return Features(
        stamp_ns=stamp_ns,
        xyz=camera.unproject(uv.astype(np.float64), depth).astype(np.float32),
        uv=uv,
        depth=depth.astype(np.float32),
        sigma_uv=sigma_uv[keep].astype(np.float32),
        sigma_depth=estimate.sigma[keep].astype(np.float32),
        response=keypoints.response[keep],
        source=estimate.source[keep],
        descriptors=keypoints.descriptors[keep],
        camera=camera,
        frame_id=frame_id,
        track_ids=np.zeros(len(keep), np.int32) if track_ids is None else track_ids[keep],
    )
