# SPDX-License-Identifier: Apache-2.0
"""Key frames: which images make the dense model, and how they are kept to be moved when a loop closes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from dense_mapping.colours import NO_PICTURE
from slam_core.camera import Camera
from slam_core.config import Config, parameter
from slam_core.geometry import FloatArray, boxminus
from slam_core.types import ByteArray, DepthImage, Float32Array

_MAX_PIXELS = 320 * 240
"""Larger depth images are halved until they have no more pixels, px."""

_DEPTH_UNIT = 0.00025
_SIGMA_UNIT = 0.0005
_MAX_SIGMA = 0.12
"""Standard deviation of depth beyond which a pixel is left out, m; the largest that a byte of ``_SIGMA_UNIT`` holds."""
_ANGLE_DEG = 11.0
"""Turn since the last key frame from which on a frame becomes one, deg."""


@dataclass(frozen=True)
class KeyframeConfig(Config):
    """Selection of key frames, and of their pixels that count."""

    distance: float = parameter(0.22, "a key frame every so much way", unit="m", minimum=0.01)
    min_depth: float = parameter(0.3, "depth below which a pixel is left out", unit="m", minimum=0.0)
    max_depth: float = parameter(5.0, "depth beyond which a pixel is left out", unit="m", minimum=0.5, maximum=16.0)


class KeyframeSelector:
    """Says which frames of one camera are far enough from the key frame before."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._last: FloatArray | None = None

    def wants(self, T_map_camera: FloatArray) -> bool:
        """True if a frame at this pose is a key frame; the next ones are then compared with it."""
        if self._last is not None:
            moved = boxminus(T_map_camera, self._last)
            near = np.linalg.norm(moved[:3]) < self._config.distance
            if near and np.linalg.norm(moved[3:]) < np.radians(_ANGLE_DEG):
                return False
        self._last = T_map_camera
        return True


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A depth image as small as it may be kept: depth in quarters, sigma in halves of a millimetre; 0: no reading.

    ``picture``: (height, width, 3) uint8, or of no size. ``spacing``: pixels from one that is kept to the next.
    """

    stamp_ns: int
    camera: Camera
    depth_units: npt.NDArray[np.uint16]
    sigma_units: ByteArray
    picture: ByteArray
    spacing: int = 1

    @property
    def depth(self) -> Float32Array:
        """Depth (height, width) m, 0 where there is none."""
        return self.depth_units.astype(np.float32) * np.float32(_DEPTH_UNIT)

    @property
    def sigma(self) -> Float32Array:
        """Standard deviation (height, width) m."""
        return self.sigma_units.astype(np.float32) * np.float32(_SIGMA_UNIT)


@dataclass(eq=False)
class PlacedKeyframe:
    """A key frame of ``camera`` with the pose T_map_camera at which it is in the field."""

    camera: str
    keyframe: Keyframe
    T_map_camera: FloatArray


def make_keyframe(image: DepthImage, config: KeyframeConfig, picture: ByteArray | None = None) -> Keyframe:
    """The key frame of a depth image; ``picture`` (h, w) or (h, w, 3) uint8, by default the amplitude as grey."""
    if picture is None and image.amplitude is not None:
        picture = grey_levels(image.amplitude)
    if picture is not None and not picture.size:
        picture = None
    if picture is not None and picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    depth, sigma, camera = image.depth, image.sigma, image.camera
    with np.errstate(invalid="ignore"):
        good = (depth >= config.min_depth) & (depth <= config.max_depth) & (sigma <= _MAX_SIGMA)
    depth, sigma = np.where(good, depth, 0.0).astype(np.float32), np.where(good, sigma, 0.0).astype(np.float32)
    # Every other pixel, not a mean: a mean over an edge would be a point in the air.
    spacing = thinning(depth.shape)
    depth, sigma = depth[::spacing, ::spacing], sigma[::spacing, ::spacing]
    camera = thinned_camera(camera, spacing, depth.shape)
    while picture is not None and picture.shape[0] > depth.shape[0]:
        picture = _halved(picture)
    return Keyframe(
        image.stamp_ns,
        camera,
        np.rint(depth / _DEPTH_UNIT).astype(np.uint16),
        np.where(depth > 0.0, np.clip(np.rint(sigma / _SIGMA_UNIT), 1, 255), 0).astype(np.uint8),
        NO_PICTURE if picture is None else np.ascontiguousarray(picture),
    )


def thinning(shape: tuple[int, ...]) -> int:
    """One pixel of so many in rows and columns is kept of a depth image (height, width)."""
    spacing = 1
    while -(-shape[0] // spacing) * -(-shape[1] // spacing) > _MAX_PIXELS:
        spacing *= 2
    return spacing


def thinned_camera(camera: Camera, spacing: int, shape: tuple[int, ...]) -> Camera:
    """The camera of an image (height, width) of one pixel of ``spacing`` in rows and columns."""
    return Camera(
        shape[1], shape[0], camera.fx / spacing, camera.fy / spacing, camera.cx / spacing, camera.cy / spacing
    )


def thinned(keyframe: Keyframe, spacing: int) -> Keyframe:
    """One pixel of ``spacing`` in rows and columns, without picture; at least as far apart as they are already."""
    step = max(1, spacing // keyframe.spacing)
    depth = np.ascontiguousarray(keyframe.depth_units[::step, ::step])
    sigma = np.ascontiguousarray(keyframe.sigma_units[::step, ::step])
    camera = thinned_camera(keyframe.camera, step, depth.shape)
    return Keyframe(keyframe.stamp_ns, camera, depth, sigma, NO_PICTURE, step * keyframe.spacing)


def with_picture(keyframe: Keyframe, picture: ByteArray) -> Keyframe:
    """The key frame with a picture (h, w, 3) uint8 of its camera, in the pixels of its image before that was halved.

    Raises
    ------
    ValueError
        For a picture that halving does not bring to the key frame's size.
    """
    height, width = keyframe.camera.height, keyframe.camera.width
    halved = picture
    while halved.shape[0] > height:
        halved = _halved(halved)
    if halved.shape != (height, width, 3):
        raise ValueError(f"a colour image of {picture.shape} is not that of a depth image of {(height, width)}")
    return replace(keyframe, picture=np.ascontiguousarray(halved))


def _halved(picture: ByteArray) -> ByteArray:
    return np.asarray(cv2.blur(picture, (2, 2))[::2, ::2], dtype=np.uint8)


def grey_levels(amplitude: Float32Array) -> ByteArray:
    """Amplitude as 0..255: a picture as it is; a ToF amplitude, which falls with range squared, by its root."""
    values = np.maximum(np.nan_to_num(amplitude), 0.0)
    top = float(np.percentile(values, 99.5))
    if 1.0 < top <= 255.0:
        return np.asarray(np.clip(values, 0.0, 255.0).astype(np.uint8))
    root = np.sqrt(values)
    return np.asarray(np.clip(root * (255.0 / max(float(np.sqrt(top)), 1e-6)), 0.0, 255.0).astype(np.uint8))
