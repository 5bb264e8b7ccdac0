# SPDX-License-Identifier: Apache-2.0
"""Depth of a stereo camera's features by the ToF camera beside it (11.2, 11.4), corrected for what both tell."""

from __future__ import annotations

import dataclasses

import numpy as np

from slam_core.camera import StereoCamera
from slam_core.geometry import FloatArray
from slam_core.types import Counters, DepthImage, FeatureSource, Float32Array, StereoImages
from stereo_frontend.assembly import DepthEstimate
from stereo_frontend.depth.depth_fusion import MappedDepth, fuse_depth, map_depth
from stereo_frontend.depth.range_self_calibration import RangeDifferences, RangeSelfCalibration
from stereo_frontend.frontend_config import FrontendConfig


class TofDepth:
    """Replaces depths by stereo by those of the ToF camera, or fuses both, as the mode says."""

    def __init__(self, config: FrontendConfig, counters: Counters) -> None:
        self._mode = config.mode
        self._config = config.fusion
        self.counters = counters
        self.calibration = RangeSelfCalibration(config.range_calibration)

    def reset(self) -> None:
        """Forget the range camera's errors."""
        self.calibration.reset()

    def added_to(
        self,
        stereo: DepthEstimate,
        uv: Float32Array,
        images: StereoImages,
        depth: DepthImage | None,
        T_left_tof: FloatArray | None,
    ) -> DepthEstimate:
        """Depth of left pixels ``uv`` (n, 2): that by stereo, with the ToF camera's where the mode asks for it.

        Parameters are those of :meth:`stereo_frontend.frontend.Frontend.measure`.
        """
        tof = None if self._mode == "stereo" else self._mapped(images, uv, stereo, depth, T_left_tof)
        if tof is None:
            return stereo
        seen = np.isfinite(tof.depth)
        alone = seen & ~np.isfinite(stereo.depth) if self._mode == "fuse" else seen
        fused, sigma, agrees = fuse_depth(stereo.depth, stereo.sigma, tof, self._config.gate)
        if self._mode == "replace":
            agrees = np.zeros_like(seen)
        self.counters.add("fused", int(agrees.sum()))
        self.counters.add("tof_alone", int(alone.sum()))
        source = np.where(alone, FeatureSource.TOF, np.where(agrees, FeatureSource.FUSED, stereo.source)).astype(
            np.uint8
        )
        return DepthEstimate(
            np.where(alone, tof.depth, np.where(agrees, fused, stereo.depth)),
            np.where(alone, tof.sigma, np.where(agrees, sigma, stereo.sigma)),
            source,
        )

    def _mapped(
        self,
        images: StereoImages,
        uv: Float32Array,
        stereo: DepthEstimate,
        depth: DepthImage | None,
        T: FloatArray | None,
    ) -> MappedDepth | None:
        if depth is None:
            self.counters.add("tof_missing")
            return None
        if T is None:
            raise ValueError(f"mode '{self._mode}' needs T_left_tof: a missing transform is never identity")
        age = abs(depth.stamp_ns - images.stamp_ns) * 1e-9
        if age > self._config.max_age:
            self.counters.add("tof_too_old")
            return None
        return self._corrected(uv, stereo, images.stereo, depth, T, age)

    def _corrected(
        self, uv: Float32Array, stereo: DepthEstimate, pair: StereoCamera, depth: DepthImage, T: FloatArray, age: float
    ) -> MappedDepth:
        """Depth of left pixels with what is known of the range camera's errors, which what both see tells."""
        calibration = self.calibration
        fields = calibration.look(depth)
        mapped = map_depth(uv, stereo.depth, pair.camera, calibration.corrected(depth, fields), T, age)
        if fields is None:
            return mapped
        seen = np.flatnonzero(np.isfinite(mapped.depth))
        sigma = mapped.sigma.copy()
        sigma[seen] = np.hypot(sigma[seen], calibration.sigma(fields, mapped.uv[seen]) / mapped.ray_length[seen])
        both = seen[np.isfinite(stereo.depth[seen])]
        depths, sigmas = (
            np.column_stack([getattr(e, name)[both] for e in (mapped, stereo)]) for name in ("depth", "sigma")
        )
        differences = RangeDifferences.between(mapped.uv[both], depths, sigmas, mapped.ray_length[both])
        calibration.learn(depth, fields, differences)
        return dataclasses.replace(mapped, sigma=sigma)
