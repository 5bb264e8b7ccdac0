# SPDX-License-Identifier: Apache-2.0
"""Rectification of a raw stereo pair from its two camera infos.

Thesis section 2.4, Hartley and Zisserman section 11.12.

After it, both images have one camera model without distortion, corresponding points lie on the same row and
``disparity = u_left - u_right`` is positive. The maps are computed once per calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial

import cv2
import numpy as np
import numpy.typing as npt

from slam_core.camera import Camera, CameraInfo, StereoCamera
from slam_core.geometry import FloatArray
from slam_core.runtime.in_place import in_place
from slam_core.types import ByteArray, Float32Array, MakeColour, MakeImage, StereoImages, no_colour

_OUTSIDE = -10.0
_MINIMUM_BASELINE = 1e-4
_STRIP = 32
"""Rows whose rays are computed together: what they take fits the cache, which halves the time."""


def stereo_camera_from_infos(left: CameraInfo, right: CameraInfo) -> StereoCamera:
    """The rectified pair that two camera infos describe.

    Raises
    ------
    ValueError
        If the sizes differ, if there is no baseline in P, or if left and right are swapped.
    """
    sizes = [(i.camera.width, i.camera.height) for i in (left, right)]
    if sizes[0] != sizes[1]:
        raise ValueError(f"left and right camera infos differ in size: {sizes[0]} and {sizes[1]} px")
    if abs(left.baseline) < _MINIMUM_BASELINE and abs(right.baseline) < _MINIMUM_BASELINE:
        raise ValueError(
            "neither camera info has a baseline, P[0, 3] is zero in both: calibrate the pair (slam calibrate stereo)"
        )
    baseline = right.baseline - left.baseline
    if baseline < 0.0:
        raise ValueError(
            f"left and right are swapped: the right camera lies {-baseline:.4f} m to the left of the left one "
            f"(P[0, 3] is {left.P[0, 3]:.3f} left, {right.P[0, 3]:.3f} right; the right one must be -fx * baseline)"
        )
    return StereoCamera(left.rectified, baseline)


class Rectifier:
    """Maps raw images of one camera to a rectified camera; an image that already is rectified passes through.

    Parameters
    ----------
    info
        K, D and R of the raw image.
    target
        The rectified camera; by default the one in ``info.P``.
    """

    def __init__(self, info: CameraInfo, target: Camera | None = None) -> None:
        self.source = info.camera
        self.camera = target or info.rectified
        passes = info.is_rectified and np.allclose(self.camera.K, info.camera.K, atol=1e-6)
        self._map = None if passes else FixedPointMap.between(info, self.camera)

    def __call__(self, image: ByteArray) -> ByteArray:
        """Rectified image, uint8 (height, width).

        Raises
        ------
        ValueError
            If the image is not uint8 grey or not of the size of the camera info.
        """
        return self.when_asked(image)()

    def when_asked(self, image: ByteArray) -> MakeImage:
        """Makes the rectified image; the raw one is checked now, as by a call."""
        if image.ndim != 2:
            raise ValueError(f"a camera image must be grey (height, width), got {image.shape}")
        _check_image(image, self.source)
        return partial(self._rectified, image)

    def _rectified(self, image: ByteArray) -> ByteArray:
        # Not the image itself: a message's is read-only, for which every kernel would be compiled once more.
        return image.copy() if self._map is None else self._map.grey(image)

    def colour(self, image: ByteArray) -> ByteArray:
        """Rectified image in colour, uint8 (height, width, 3); ValueError as for a grey one."""
        _check_image(image, self.source)
        return image.copy() if self._map is None else self._map.colour(image)


@dataclass(frozen=True, eq=False)
class FixedPointMap:
    """Place of each rectified pixel in the raw image, to 1/32 px.

    corner: (h, w, 2) int16, column and row of the upper left of the four pixels around it. fraction: (h, w) uint16, 32
    times the row's fraction plus the column's, in 1/32. offset: (h, w) int32 of that corner in the raw image, -1 where
    not all four lie inside.
    """

    corner: npt.NDArray[np.int16]
    fraction: npt.NDArray[np.uint16]
    offset: npt.NDArray[np.int32]

    @classmethod
    def between(cls, info: CameraInfo, target: Camera) -> FixedPointMap:
        """Map from the raw images of ``info`` to those of ``target``; one of the last two is not made again."""
        return _map_between(info.camera, tuple(info.R.ravel().tolist()), target)

    @classmethod
    def of(cls, pixels: Float32Array, width: int, height: int) -> FixedPointMap:
        """Map by raw pixels (h, w, 2) of images of that size."""
        corner, fraction = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
        u, v = corner[..., 0].astype(np.int32), corner[..., 1].astype(np.int32)
        inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
        return cls(
            np.asarray(corner, np.int16),
            np.asarray(fraction, np.uint16),
            np.where(inside, v * width + u, -1).astype(np.int32),
        )

    def grey(self, image: ByteArray) -> ByteArray:
        """A grey image, bilinear, to the byte what OpenCV makes of it."""
        raw, out = np.ascontiguousarray(image).view(), np.empty(self.offset.shape, np.uint8)
        raw.flags.writeable = False
        _remap(
            raw,
            raw.reshape(-1),
            self.corner.reshape(-1, 2),
            self.fraction.ravel(),
            self.offset.ravel(),
            out.reshape(-1),
        )
        return out

    def colour(self, image: ByteArray) -> ByteArray:
        """A picture in colour, bilinear."""
        mapped = cv2.remap(image, self.corner, self.fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(mapped, np.uint8)


@lru_cache(2)
def _map_between(camera: Camera, rotation: tuple[float, ...], target: Camera) -> FixedPointMap:
    """The maps of a pair: a recording is looked at, mapped and made a dense model of with the same ones."""
    info = CameraInfo(camera, np.reshape(rotation, (3, 3)))
    pixels = np.nan_to_num(rectification_map(info, target), nan=_OUTSIDE).astype(np.float32)
    return FixedPointMap.of(pixels, camera.width, camera.height)


@in_place()
def _remap(image, pixels, corner, fraction, offset, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (n,) from ``image`` (h, w), which ``pixels`` holds row after row; black outside."""
    one, below, scale = np.uintp(1), np.uintp(image.shape[1]), np.int32(32)
    for i in range(len(out)):
        across, down = np.int32(fraction[i] & 31), np.int32(fraction[i] >> 5)
        if offset[i] >= 0:
            at = np.uintp(offset[i])
            a, b = np.int32(pixels[at]), np.int32(pixels[at + one])
            c, d = np.int32(pixels[at + below]), np.int32(pixels[at + below + one])
        else:
            u, v = corner[i, 0], corner[i, 1]
            a, b, c, d = _grey(image, u, v), _grey(image, u + 1, v), _grey(image, u, v + 1), _grey(image, u + 1, v + 1)
        upper, lower = scale * a + across * (b - a), scale * c + across * (d - c)
        out[i] = np.uint8((scale * upper + down * (lower - upper) + np.int32(512)) >> np.int32(10))


@in_place()
def _grey(image, u, v):  # type: ignore[no-untyped-def]
    inside = 0 <= u < image.shape[1] and 0 <= v < image.shape[0]
    return np.int32(image[v, u]) if inside else np.int32(0)


class StereoRectifier:
    """Turns raw pairs into :class:`StereoImages`.

    Both images are mapped to the left camera's P, so a right P with another principal point needs no offset later.

    Parameters
    ----------
    left, right
        Camera infos as calibrated: ``right.P[0, 3] = -fx * baseline``.
    """

    def __init__(self, left: CameraInfo, right: CameraInfo) -> None:
        self.stereo = stereo_camera_from_infos(left, right)
        self._left = Rectifier(left, self.stereo.camera)
        self._right = Rectifier(right, self.stereo.camera)

    def __call__(
        self,
        stamp_ns: int,
        left: ByteArray,
        right: ByteArray,
        colour: MakeColour = no_colour,
        frame_id: str = StereoImages.frame_id,
    ) -> StereoImages:
        """Rectify one pair of raw images, uint8 (height, width) each, of one stamp; the right one when it is asked for.

        ``colour``: the left one's; ``frame_id``: that of the left camera.

        Raises
        ------
        ValueError
            As of :class:`Rectifier`, for either image, right away.
        """

        def rectified_colour() -> ByteArray | None:
            raw = colour()
            return None if raw is None else self._left.colour(raw)

        right_when_asked = self._right.when_asked(right)
        return StereoImages(
            stamp_ns, self._left(left), right_when_asked, self.stereo, frame_id=frame_id, colour=rectified_colour
        )


def rectification_map(info: CameraInfo, target: Camera) -> FloatArray:
    """Raw pixel (u, v) of every pixel of the rectified image ``target``.

    Shape (height, width, 2), NaN behind the camera.
    """
    out = np.empty((target.height, target.width, 2))
    columns, rows = np.arange(target.width, dtype=np.float64), np.arange(target.height, dtype=np.float64)
    for top in range(0, target.height, _STRIP):
        u, v = np.meshgrid(columns, rows[top : top + _STRIP])
        rays = target.unproject(np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size)) @ info.R
        out[top : top + _STRIP] = info.camera.project(rays).reshape(*u.shape, 2)
    return out


def _check_image(image: ByteArray, camera: Camera) -> None:
    if image.dtype != np.uint8:
        raise ValueError(f"a camera image must be uint8, got {image.dtype}")
    expected = (camera.height, camera.width)
    if image.shape[:2] != expected:
        raise ValueError(f"image (height, width) is {image.shape[:2]} px but its camera info says {expected} px")
