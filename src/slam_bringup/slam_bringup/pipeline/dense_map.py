"""The dense model of a run: depth images hung on the final trajectory and fused on a voxel grid (Fig. 9.6).

It is made after the run, from key frames only, so that it uses the joined trajectory and costs the estimators nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus, transform_points
from slam_core.point_cloud import voxel_mean
from slam_core.types import ByteArray, DepthImage, Float32Array, StereoImages


@dataclass(frozen=True)
class DenseMapConfig(Config):
    """Which frames make the dense model, and how fine it is."""

    keyframe_distance: float = parameter(0.3, "a key frame every so much way", unit="m", minimum=0.01)
    keyframe_angle_deg: float = parameter(15.0, "or every so much turn", unit="deg", minimum=1.0)
    voxel_size: float = parameter(0.03, "edge of a voxel", unit="m", minimum=0.005)
    max_depth: float = parameter(6.0, "depth beyond which a pixel is left out", unit="m", minimum=0.5)
    max_sigma: float = parameter(
        0.05, "standard deviation of depth beyond which a pixel is left out", unit="m", minimum=1e-3
    )


@dataclass(frozen=True, eq=False)
class ColouredCloud:
    """Points (n, 3) m and grey values (n,) uint8."""

    points: Float32Array
    grey: ByteArray

    @classmethod
    def empty(cls) -> ColouredCloud:
        """A cloud without points."""
        return cls(np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.uint8))


class DenseMap:
    """Collects the clouds of key frames in the map frame."""

    def __init__(self, config: DenseMapConfig) -> None:
        self.config = config
        self._clouds: list[tuple[Float32Array, Float32Array]] = []
        self._last_pose: FloatArray | None = None

    def wants(self, T_map_rig: FloatArray) -> bool:
        """Whether a frame at this pose is a key frame; the caller then adds its cloud."""
        if self._last_pose is not None:
            moved = boxminus(T_map_rig, self._last_pose)
            near = np.linalg.norm(moved[:3]) < self.config.keyframe_distance
            if near and np.linalg.norm(moved[3:]) < np.radians(self.config.keyframe_angle_deg):
                return False
        self._last_pose = T_map_rig
        return True

    def add_depth(self, T_map_optical: FloatArray, depth: DepthImage) -> None:
        """Add a depth image seen from a pose of its optical frame; the amplitude gives the grey values."""
        trusted = (depth.depth < self.config.max_depth) & (depth.sigma < self.config.max_sigma)
        points = depth.points()[trusted]
        picture = np.full(depth.depth.shape, 128.0, dtype=np.float32) if depth.amplitude is None else depth.amplitude
        self._add(T_map_optical, points, _grey_levels(picture)[trusted])

    def add_stereo(self, T_map_optical: FloatArray, images: StereoImages) -> None:
        """Add a stereo pair seen from a pose of its left optical frame, with depth by semi-global matching."""
        depth, sigma = dense_stereo_depth(images)
        trusted = (depth < self.config.max_depth) & (sigma < self.config.max_sigma)
        v, u = np.nonzero(trusted)
        points = images.stereo.camera.unproject(
            np.column_stack([u, v]).astype(np.float64), depth[trusted].astype(np.float64)
        )
        self._add(T_map_optical, points.astype(np.float32), images.left[trusted].astype(np.float32))

    def _add(self, T: FloatArray, points: Float32Array, grey: Float32Array) -> None:
        points, grey = voxel_mean(points, self.config.voxel_size, grey)
        self._clouds.append((transform_points(T, points.astype(np.float64)).astype(np.float32), grey))

    def fuse(self) -> ColouredCloud:
        """All key frames on one voxel grid."""
        if not self._clouds:
            return ColouredCloud.empty()
        points = np.concatenate([cloud for cloud, _ in self._clouds])
        grey = np.concatenate([values for _, values in self._clouds])
        points, grey = voxel_mean(points, self.config.voxel_size, grey)
        return ColouredCloud(points, np.clip(np.rint(grey), 0, 255).astype(np.uint8))


def _grey_levels(amplitude: Float32Array) -> Float32Array:
    """Amplitude as 0..255, its square root first: amplitude falls with range squared, and eyes like it flatter."""
    root = np.sqrt(np.maximum(np.nan_to_num(amplitude), 0.0))
    top = float(np.percentile(root, 99.0))
    return np.asarray(np.clip(root * (255.0 / max(top, 1e-6)), 0.0, 255.0), dtype=np.float32)


def dense_stereo_depth(images: StereoImages) -> tuple[Float32Array, Float32Array]:
    """Depth and sigma (height, width) m, infinite where unknown, by semi-global matching (Hirschmueller 2008).

    A quarter of a pixel of disparity is taken as its standard deviation: enough to weigh far against near.
    """
    stereo = images.stereo
    disparities = 16 * int(np.ceil(images.left.shape[1] / 8 / 16))
    matcher = cv2.StereoSGBM.create(
        minDisparity=1, numDisparities=disparities, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1,
        uniquenessRatio=12, speckleWindowSize=120, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(images.left, images.right).astype(np.float32) / 16.0
    known = disparity > 1.0
    disparity = np.where(known, disparity, 1.0)
    depth = np.where(known, stereo.camera.fx * stereo.baseline / disparity, np.inf).astype(np.float32)
    sigma = np.where(known, depth * 0.25 / disparity, np.inf).astype(np.float32)
    return depth, sigma
