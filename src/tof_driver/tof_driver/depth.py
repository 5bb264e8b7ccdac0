# SPDX-License-Identifier: Apache-2.0
"""From what a range camera measures to a rectified depth image that knows how good each pixel is.

    metres -> judge each pixel -> sigma -> reject flying pixels -> depth along z -> rectify

Works the same for time-of-flight cameras (range along the ray, amplitude) and for any depth camera topic (depth
along z, no amplitude): only :class:`DepthConfig` differs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera
from slam_core.config import Config, group, parameter
from slam_core.runtime.in_place import in_place
from slam_core.types import AnyArray, ByteArray, Counters, DepthImage, Float32Array
from tof_driver.distortion import DepthDistortion, DepthDistortionConfig
from tof_driver.mask import (
    MAXIMUM_INCIDENCE_DEG,
    NOISE_MULTIPLE,
    VALID,
    MaskConfig,
    Reason,
    judge_pixels,
    reject_flying_pixels,
)
from tof_driver.noise import NoiseConfig, range_sigma
from tof_driver.resample import RectificationMap

MILLIMETRES_INVALID = 65535


@dataclass(frozen=True)
class DepthConfig(Config):
    """Configuration of a range or depth camera."""

    measurement: str = parameter(
        "range",
        "what a pixel of the input holds: range along its ray, or depth along z (REP-118)",
        choices=("range", "depth"),
    )
    noise: NoiseConfig = group(NoiseConfig)
    mask: MaskConfig = group(MaskConfig)
    depth_distortion: DepthDistortionConfig = group(DepthDistortionConfig)


class DepthProcessor:
    """Turns the images of one range camera into :class:`DepthImage` objects.

    Parameters
    ----------
    config
        What the input holds, noise model and limits.
    camera
        Intrinsics and lens distortion of the raw images.
    rectified
        Camera of the output, without distortion (the P of a camera info); None: the same camera matrix. Where it equals
        ``camera`` the images are passed through without resampling.

    Attributes
    ----------
    output_camera
        Camera of the depth images that :meth:`process` returns.
    counters
        ``images``, raw pixels by :class:`Reason` and ``output_pixels`` (rectified pixels with depth) since the start.
    share_with_depth
        Share of the newest image's pixels that have depth.
    """

    def __init__(self, config: DepthConfig, camera: Camera, rectified: Camera | None = None) -> None:
        self.config = config
        self.camera = camera
        self.output_camera = rectified or replace(camera, distortion_model="none", distortion=())
        self.counters = Counters()
        self.share_with_depth = 0.0
        self._noise = _with_model(config.noise, config.measurement)
        same = camera.is_rectified and np.allclose(self.output_camera.K, camera.K, atol=1e-6)
        self._rectification = None if same else RectificationMap.between(camera, self.output_camera)
        self._ray_length = _ray_length(camera)
        distortion = config.depth_distortion
        self._distortion = None if distortion.is_exact else DepthDistortion(distortion, camera)
        self._pixel_angle = 1.0 / min(camera.fx, camera.fy)

    def process(
        self, stamp_ns: int, image: AnyArray, amplitude: AnyArray | None = None, intensity: AnyArray | None = None
    ) -> DepthImage:
        """Rectified depth with sigma of one measurement.

        Parameters
        ----------
        stamp_ns
            Header stamp, handed through.
        image
            Range or depth, shape (height, width): uint16 in mm (0 and 65535: no reading) or float in m (NaN, infinite,
            zero or negative: no reading).
        amplitude, intensity
            Same shape, any real type, or None where the camera has none.

        Raises
        ------
        ValueError
            For a shape that is not the camera's, or a type that is neither uint16 nor floating.
        """
        measured = self._metres(image)
        amplitude = self._picture("amplitude", amplitude)
        intensity = self._picture("intensity", intensity)
        distance = measured * self._ray_length if self.config.measurement == "depth" else measured
        reason, sigma = self._believable(distance, amplitude)
        if self._distortion is not None:
            sigma = np.hypot(sigma, self._distortion.sigma * distance)
            distance = distance * self._distortion.factor
        depth = np.empty_like(distance)
        counts = np.zeros(len(Reason), np.int64)
        flat = (a.reshape(-1) for a in (distance, reason, self._ray_length, depth, sigma))
        _along_z(*flat, counts)
        depth, sigma = self._rectified(depth, sigma)
        self._count(counts, depth)
        return DepthImage(
            stamp_ns,
            depth,
            sigma,
            self.output_camera,
            self._rectified_picture(amplitude),
            self._rectified_picture(normalise(intensity)),
        )

    def colour(self, picture: ByteArray) -> ByteArray:
        """A picture (h, w, 3) uint8 in the pixels of the raw image, rectified; ValueError for another size."""
        self._check_shape("color image", picture[..., 0])
        return picture if self._rectification is None else self._rectification.colour(picture)

    def _metres(self, image: AnyArray) -> Float32Array:
        self._check_shape("image", image)
        if image.dtype == np.uint16:
            metres = np.empty(image.shape, np.float32)
            _metres_of_millimetres(np.ascontiguousarray(image, np.uint16).ravel(), metres.reshape(-1))
            return metres
        if not np.issubdtype(image.dtype, np.floating):
            raise ValueError(f"range image must be uint16 (mm) or float (m), got {image.dtype}")
        return np.array(image, np.float32, order="C")

    def _picture(self, name: str, image: AnyArray | None) -> Float32Array | None:
        if image is None:
            return None
        self._check_shape(name, image)
        return np.array(image, np.float32, order="C")

    def _check_shape(self, name: str, image: AnyArray) -> None:
        expected = (self.camera.height, self.camera.width)
        if image.shape != expected:
            raise ValueError(
                f"{name} must have shape {expected} (rows, columns) like its camera_info, got {image.shape}"
            )

    def _believable(self, distance: Float32Array, amplitude: Float32Array | None) -> tuple[ByteArray, Float32Array]:
        noise, mask = self._noise, self.config.mask
        if noise.model == "quadratic":
            amplitude = None  # a picture, not the strength of the camera's own light: it judges nothing
        reason = judge_pixels(mask, distance, amplitude)
        if noise.model == "quadratic":
            sigma = np.empty_like(distance)
            flat = (a.reshape(-1) for a in (distance, self._ray_length, sigma))
            _quadratic_sigma(*flat, np.float32(noise.constant), np.float32(noise.quadratic))
        else:
            sigma = range_sigma(noise, distance, amplitude)
        if mask.flying_pixels:
            reject_flying_pixels(distance, sigma, reason, self._pixel_angle)
        return reason, sigma

    def _rectified(self, depth: Float32Array, sigma: Float32Array) -> tuple[Float32Array, Float32Array]:
        if self._rectification is None:
            return depth, sigma
        slope = self._pixel_angle * np.tan(np.radians(MAXIMUM_INCIDENCE_DEG))
        return self._rectification.depth(depth, sigma, slope, NOISE_MULTIPLE)

    def _rectified_picture(self, image: Float32Array | None) -> Float32Array | None:
        return image if image is None or self._rectification is None else self._rectification.image(image)

    def _count(self, counts: npt.NDArray[np.int64], depth: Float32Array) -> None:
        seen = int(np.isfinite(depth).sum()) if self._rectification is not None else int(counts[Reason.VALID])
        self.share_with_depth = seen / depth.size
        self.counters.add("images")
        self.counters.add("output_pixels", seen)
        for value, amount in enumerate(counts):
            if amount:
                self.counters.add(Reason(value).name.lower(), int(amount))


@in_place()
def _metres_of_millimetres(millimetres, out):  # type: ignore[no-untyped-def]
    for i in range(len(millimetres)):
        known = millimetres[i] != MILLIMETRES_INVALID
        out[i] = np.float32(millimetres[i]) * np.float32(0.001) if known else np.float32(np.nan)


@in_place(error_model="numpy")
def _quadratic_sigma(distance, ray_length, out, constant, quadratic):  # type: ignore[no-untyped-def]
    """Fill ``out`` with the standard deviation along the ray of a camera whose noise grows with depth squared."""
    for i in range(len(out)):
        z = distance[i] / ray_length[i]
        out[i] = (constant + quadratic * z * z) * ray_length[i]


@in_place(error_model="numpy")
def _along_z(distance, reason, ray_length, depth, sigma, counts):  # type: ignore[no-untyped-def]
    """Fill ``depth``, and turn ``sigma`` into that of depth; NaN where a pixel is not valid. Counts the reasons."""
    for i in range(len(depth)):
        z, s = distance[i] / ray_length[i], sigma[i] / ray_length[i]
        valid = reason[i] == VALID
        depth[i] = z if valid else np.float32(np.nan)
        sigma[i] = s if valid else np.float32(np.nan)
    for i in range(len(reason)):
        if reason[i] != VALID:
            counts[reason[i]] += 1
    counts[VALID] = reason.size - counts.sum()


def normalise(intensity: Float32Array | None) -> Float32Array | None:
    """``(I - min) / (max - min)`` (Eq. 3.3), in [0, 1]; zero for a constant image and where the input is not finite."""
    if intensity is None:
        return None
    finite = np.isfinite(intensity)
    if not finite.any():
        return np.zeros_like(intensity)
    low, high = intensity[finite].min(), intensity[finite].max()
    scaled = (intensity - low) / max(high - low, np.float32(1e-12))
    return np.where(finite, scaled, np.float32(0.0)).astype(np.float32)


def _with_model(noise: NoiseConfig, measurement: str) -> NoiseConfig:
    """``auto`` resolved: cameras that measure range are taken for time of flight, others for structured light."""
    model = {"range": "amplitude", "depth": "quadratic"}[measurement] if noise.model == "auto" else noise.model
    return replace(noise, model=model)


def _ray_length(camera: Camera) -> Float32Array:
    """Range over depth of each raw pixel, |(x/z, y/z, 1)|, shape (height, width)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    xy = camera.normalised_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    length = np.sqrt(1.0 + np.square(xy).sum(axis=1))
    return np.asarray(length.reshape(camera.height, camera.width), dtype=np.float32)
